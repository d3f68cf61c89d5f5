// A fragment's colour from the map of a laser station (CEIG 2019, section 3.2), and whether the map shows its surface there.
//
// A map lies in a layer of a texture as six squares, three in a row: both caps, and the band in quarters; coarser levels of its colours stand side
// by side below (renderer/splats/upload/maps.py). Lookups are bilinear among those of four
// texels that show the splat's own surface, as their depths tell; see pipeline/maps/sample.py.

#include "polar_capped.glsl"

#ifdef MAP_COLORS
layout(binding = 1) uniform highp sampler2DArray map_colors;  // sRGB; alpha: the share of a texel that shows a surface
#endif
layout(binding = 2) uniform highp usampler2DArray map_depths;  // 0 none, else 1 + log(distance / nearest) in steps

flat in vec3 from_station;
flat in vec3 map_u, map_v;
#ifdef ELLIPSOID
flat in vec3 map_w;
#endif
flat in vec4 map_depth;
flat in vec4 map_eye;
flat in ivec2 map_place;

const float LEAST_VALID = 0.25;        // of a lookup's bilinear weights
const float MOST_OF_DISTANCE = 0.5;    // a splat whose slack is more surrounds the station
const float LEAST_FACING = 0.3;        // cosine between view ray and normal from which on fragments are moved
const float BEHIND_ALL = exp2(-40.0);  // what depths of the second tier are times: behind all of the first

const uint SHOWN = 0u, HIDDEN = 1u, FREE = 2u;  // what a map shows of a fragment: its surface; one before it; what lies behind it, or nothing

// The squared distance from which on nothing is drawn of what a map hides: the farther from a splat's own point, the less likely it is that
// there is a surface which no station saw. pump_e57, a hundredth of its points, 20 % off the scanner: spill over silhouettes and what is missing come
// to 7.0 and 5.0 % without this, 4.4 and 5.7 % with 0.5, 3.9 and 5.9 % with 0.25.
const float HIDDEN_WITHIN = 0.25;

// A splat that is looked up in part is trimmed from its rim inwards.
bool is_no_fragment(uint what, float d2) {
    float trimmed = what == FREE ? 1.0 : what == HIDDEN ? 1.0 - HIDDEN_WITHIN : 0.0;
    return d2 >= 1.0 - map_share * trimmed;
}

bool is_second_tier(uint what, float d2) { return what == HIDDEN && d2 >= 1.0 - map_share; }

// Where a texel of the chart lies in the layer. Column and row may be one beyond the chart's ends: the band goes round, caps end there.
ivec2 texel_at(ivec2 at, uint chart, int height) {
    at.y = clamp(at.y, 0, height - 1);
    int first = int(chart) * height, x = at.x - first, width = chart == BAND ? 4 * height : height;
    if (chart == BAND) x = x < 0 ? x + width : x < width ? x : x - width;
    else x = clamp(x, 0, width - 1);
    int square = int(chart);
    for (; x >= height; ++square) x -= height;  // no division: processors that draw are slow at it
    return square < 3 ? ivec2(x + square * height, at.y) : ivec2(x + (square - 3) * height, at.y + height);
}

// Four texels from `corner` on, which lie side by side but for those at the ends of squares.
struct Taps { ivec2 at[4]; };

Taps taps_at(ivec2 corner, uint chart, int height) {
    Taps taps;
    taps.at[0] = texel_at(corner, chart, height);
    taps.at[3] = texel_at(corner + 1, chart, height);
    if (taps.at[3] == taps.at[0] + 1) {
        taps.at[1] = taps.at[0] + ivec2(1, 0);
        taps.at[2] = taps.at[0] + ivec2(0, 1);
    } else {
        taps.at[1] = texel_at(corner + ivec2(1, 0), chart, height);
        taps.at[2] = texel_at(corner + ivec2(0, 1), chart, height);
    }
    return taps;
}

// Whether the fragment's splat is looked up at the finest level, and moved there.
#ifdef LOOKED_UP
bool is_finest() { return LOOKED_UP >= 2; }
bool is_moved() { return LOOKED_UP == 3; }
#else
bool is_finest() { return map_depth.w == 0.0; }
bool is_moved() { return map_eye.w > 0.0; }
#endif

// The fragment against the station.
#ifdef ELLIPSOID
vec3 against_station() { return from_station + mat3(map_u, map_v, map_w) * on_ball(); }
#else
vec3 against_station() { return from_station + place.x * map_u + place.y * map_v; }
#endif

struct MapLookup {
    uint chart;
    vec2 at;       // column and row
    Taps taps;     // the four texels about it
    vec4 weight;   // of those of them that have the splat's surface
    float closer;  // codes by which that lies closer than the direction asked for, their mean; before: the weight of texels before it
    float before;
    uint what;
};

// The four texels about a direction that show the splat's surface.
MapLookup fitting(vec3 direction) {
    float away = length(direction), code = 1.0 + log(away * map_depth.y) * map_depth.z, off = map_depth.x / away * map_depth.z;
    MapLookup found;
    found.chart = chart_of(direction);
    found.at = project(direction, float(map_place.y));
    ivec2 corner = ivec2(floor(found.at - 0.5));
    vec2 share = found.at - 0.5 - vec2(corner);
    found.taps = taps_at(corner, found.chart, map_place.y);
    found.weight = vec4(0.0);
    found.closer = found.before = 0.0;
    for (int i = 0; i < 4; ++i) {
        ivec2 tap = ivec2(i & 1, i >> 1);
        float weight = (tap.x == 1 ? share.x : 1.0 - share.x) * (tap.y == 1 ? share.y : 1.0 - share.y);
        float there = float(texelFetch(map_depths, ivec3(found.taps.at[i], map_place.x), 0).r);
        if (there == 0.0) continue;
        if (abs(there - code) <= off) {
            found.weight[i] = weight;
            found.closer += weight * (code - there);
        } else if (there < code) found.before += weight;
    }
    float fits = dot(found.weight, vec4(1.0));
    found.what = fits >= LEAST_VALID ? SHOWN : found.before >= LEAST_VALID ? HIDDEN : FREE;
    found.closer /= max(fits, 1e-6);
    return found;
}

// Where the view ray meets the surface that the map shows, taken for as steep as the splat: one step of parallax mapping (Kaneko et al., Detailed
// shape representation with parallax mapping, 2001). Against one colour it gains 3 to 4 dB away from the scanner where it is without 1 to 2
// (pump_e57, a hundredth of the points), and trims what would stand out over silhouettes there.
vec3 on_surface(vec3 at, float closer) {
    vec3 ray = normalize(at - map_eye.xyz), normal = normalize(cross(map_u, map_v));
    float facing = dot(ray, normal);
    return abs(facing) < LEAST_FACING ? at : at + ray * (dot(at, normal) * (exp(-closer / map_depth.z) - 1.0) / facing);
}

// Of splats that are looked up at a coarser level the texel in which the fragment lies decides.
MapLookup look_up_depth() {
    vec3 direction = against_station();
    float away = length(direction);
    MapLookup found;
    found.what = HIDDEN;
    if (map_depth.x > MOST_OF_DISTANCE * away) return found;
    if (is_finest()) {
        found = fitting(direction);
        if (is_moved() && found.what == SHOWN) found = fitting(on_surface(direction, found.closer));
        return found;
    }
    float code = 1.0 + log(away * map_depth.y) * map_depth.z;
    found.chart = chart_of(direction);
    found.at = project(direction, float(map_place.y));
    float there = float(texelFetch(map_depths, ivec3(texel_at(ivec2(floor(found.at)), found.chart, map_place.y), map_place.x), 0).r);
    bool fits = there != 0.0 && abs(there - code) * away <= map_depth.x * map_depth.z;
    found.what = fits ? SHOWN : there != 0.0 && there < code ? HIDDEN : FREE;
    return found;
}

#ifdef MAP_COLORS
vec3 look_up_color(MapLookup found) {
    int height = map_place.y;
    if (!is_finest()) {  // the mean about the texel that fits
        int level = int(map_depth.w);
        ivec2 begin = ivec2(3 * height - (3 * height >> (level - 1)), 2 * height);
        ivec2 at = texel_at(ivec2(floor(found.at * exp2(-float(level)))), found.chart, height >> level);
        return texelFetch(map_colors, ivec3(begin + at, map_place.x), 0).rgb;
    }
    vec3 sum = vec3(0.0);
    for (int i = 0; i < 4; ++i)
        if (found.weight[i] > 0.0) sum += found.weight[i] * texelFetch(map_colors, ivec3(found.taps.at[i], map_place.x), 0).rgb;
    return sum / dot(found.weight, vec4(1.0));
}
#endif
