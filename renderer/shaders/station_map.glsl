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
flat in vec4 map_depth;
flat in ivec2 map_place;

const float LEAST_VALID = 0.25;        // of a lookup's bilinear weights
const float MOST_OF_DISTANCE = 0.5;    // a splat whose slack is more surrounds the station
const float BEHIND_ALL = exp2(-40.0);  // what depths of the second tier are times: behind all of the first

const uint SHOWN = 0u, HIDDEN = 1u, FREE = 2u;  // what a map shows of a fragment: its surface; one before it; what lies behind it, or nothing

ivec2 texel_at(ivec2 at, uint chart, int height) {
    at.y = clamp(at.y, 0, height - 1);
    int first = int(chart) * height;
    if (chart == BAND) at.x = first + (at.x - first + 4 * height) % (4 * height);
    else at.x = clamp(at.x, first, first + height - 1);
    int square = at.x / height;
    return ivec2(at.x % height + square % 3 * height, at.y + square / 3 * height);
}

struct MapLookup {
    uint chart;
    vec2 at;       // column and row
    vec4 weight;   // of the four texels that have the splat's surface
    uint what;
};

MapLookup look_up_depth(vec2 on_square) {
    vec3 direction = from_station + on_square.x * map_u + on_square.y * map_v;
    float away = length(direction), height = float(map_place.y);
    MapLookup found = MapLookup(chart_of(direction), project(direction, height), vec4(0.0), HIDDEN);
    if (map_depth.x > MOST_OF_DISTANCE * away) return found;
    float code = 1.0 + log(away * map_depth.y) * map_depth.z, off = map_depth.x / away * map_depth.z;
    ivec2 corner = ivec2(floor(found.at - 0.5));
    vec2 share = found.at - 0.5 - vec2(corner);
    float before = 0.0;
    for (int i = 0; i < 4; ++i) {
        ivec2 tap = ivec2(i & 1, i >> 1);
        float weight = (tap.x == 1 ? share.x : 1.0 - share.x) * (tap.y == 1 ? share.y : 1.0 - share.y);
        float there = float(texelFetch(map_depths, ivec3(texel_at(corner + tap, found.chart, map_place.y), map_place.x), 0).r);
        if (there == 0.0) continue;
        if (abs(there - code) <= off) found.weight[i] = weight;
        else if (there < code) before += weight;
    }
    if (dot(found.weight, vec4(1.0)) >= LEAST_VALID) found.what = SHOWN;
    else found.what = before >= LEAST_VALID ? HIDDEN : FREE;
    return found;
}

#ifdef MAP_COLORS
vec4 color_at(ivec2 at, uint chart, int level) {
    int height = map_place.y;
    ivec2 corner = level == 0 ? ivec2(0) : ivec2(3 * height - (3 * height >> (level - 1)), 2 * height);
    return texelFetch(map_colors, ivec3(corner + texel_at(at, chart, height >> level), map_place.x), 0);
}

vec3 look_up_color(MapLookup found) {
    int level = int(map_depth.w);
    vec2 at = found.at * exp2(-float(level)) - 0.5;
    ivec2 corner = ivec2(floor(at));
    vec2 share = at - vec2(corner);
    vec4 sum = vec4(0.0);
    for (int i = 0; i < 4; ++i) {
        ivec2 tap = ivec2(i & 1, i >> 1);
        if (level == 0 && found.weight[i] == 0.0) continue;
        vec4 texel = color_at(corner + tap, found.chart, level);
        float weight = (tap.x == 1 ? share.x : 1.0 - share.x) * (tap.y == 1 ? share.y : 1.0 - share.y) * texel.a;
        sum += weight * vec4(texel.rgb, 1.0);
    }
    return sum.rgb / max(sum.a, 1e-6);
}
#endif
