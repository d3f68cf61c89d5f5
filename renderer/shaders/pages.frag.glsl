// The colour of a fragment from the pages of its photograph: the level that it asks for where that is resident, else the
// finest coarser one (2020, section 4.1). What is asked for is counted, page by page (4.2).

layout(binding = 2) uniform sampler2DArray page_pool;
layout(std430, binding = 12) readonly buffer PageSlots { uint page_slots[]; };  // 0 where a page is not resident, else its slot + 1; with COUNTED where BY_PART draws it now
layout(std430, binding = 13) readonly buffer PageGrids { uvec4 grid_rows[]; };  // first page, columns, width and height in texels
#ifdef ASKS
layout(std430, binding = 14) buffer Feedback { uint feedback[]; };              // of each page: fragments in the view, in its margin
#endif
uniform uvec4 pool_shape;  // texels of a page, of its border, pages a row and rows of a layer
uniform vec4 inner;        // the view in px of the picture: left, top, right, bottom; beyond lies its margin

const uint COUNTED = 0x80000000u;
uint slot_of(uint page) { return page_slots[page] & ~COUNTED; }

flat in vec3 page_centre, page_u, page_v;
#ifdef ELLIPSOID
flat in vec3 page_w;
#endif
flat in float page_level;
flat in uvec4 page_grids;

uint page_of(uint grid, vec2 texel, out vec2 inside) {
    uvec4 row = grid_rows[grid];
    uvec2 last = (row.zw - 1u) / pool_shape.x;
    uvec2 cell = min(uvec2(texel) / pool_shape.x, last);
    inside = texel - vec2(cell * pool_shape.x) + float(pool_shape.y);
    return row.x + cell.y * row.y + cell.x;
}

vec3 pool_color(uint slot, vec2 inside) {
    uint a_layer = pool_shape.z * pool_shape.w, at = slot % a_layer;
    vec2 corner = vec2(at % pool_shape.z, at / pool_shape.z) * float(pool_shape.x + 2u * pool_shape.y);
    return textureLod(page_pool, vec3((corner + inside) / vec2(textureSize(page_pool, 0).xy), float(slot / a_layer)), 0.0).rgb;
}

bool in_view() { return all(greaterThanEqual(gl_FragCoord.xy, inner.xy)) && all(lessThan(gl_FragCoord.xy, inner.zw)); }

// Its colour, and by how many levels what was shown is coarser than what was asked for; negative without a photograph. With BY_PART
// a picture is added up in parts, each with the pages that the pool holds at once: fragments of other pages are left out.
#ifdef BY_PART
uniform bool first_part;
#define NO_PAGE if (!first_part) discard; return vec4(-1.0);
#else
#define NO_PAGE return vec4(-1.0);
#endif
vec4 paged_color() {
    if (page_grids.y == 0u) { NO_PAGE }
#ifdef ELLIPSOID
    vec3 seen = page_centre + mat3(page_u, page_v, page_w) * on_ball();
#else
    vec2 on_disc = clamp(place.xy, -1.0, 1.0);
    vec3 seen = page_centre + on_disc.x * page_u + on_disc.y * page_v;
#endif
    if (seen.z <= 0.0) { NO_PAGE }
    vec2 at = clamp(seen.xy / seen.z / vec2(page_grids.zw), 0.0, 1.0);
    float level = clamp(page_level, 0.0, float(page_grids.y - 1u));
    uint finest = uint(level), last = page_grids.y - 1u;
    vec2 inside;
    uint slot = 0u, shown = finest;
    for (uint l = finest; l <= last; ++l) {
        uint grid = page_grids.x + l;
        uint page = page_of(grid, at * vec2(grid_rows[grid].zw), inside);
#ifdef BY_PART
        if (l == finest && (page_slots[page] & COUNTED) == 0u) discard;
#endif
#ifdef ASKS
        if (l == finest) atomicAdd(feedback[2u * page + (in_view() ? 0u : 1u)], 1u);
#endif
        slot = slot_of(page);
        shown = l;
        if (slot != 0u) break;
    }
    if (slot == 0u) return vec4(-1.0);
    vec3 color = pool_color(slot - 1u, inside);
    float blend = level - float(finest);
    if (shown == finest && blend > 0.0 && finest < last) {
        uint grid = page_grids.x + finest + 1u;
        uint coarser = slot_of(page_of(grid, at * vec2(grid_rows[grid].zw), inside));
        if (coarser != 0u) color = mix(color, pool_color(coarser - 1u, inside), blend);
    }
    return vec4(color, float(shown - finest));
}
