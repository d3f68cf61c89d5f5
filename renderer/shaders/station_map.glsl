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

struct MapLookup {
    uint chart;
    vec2 at;       // column and row
    vec4 weight;   // of the four texels that have the splat's surface
    uint what;
};

// With `weighs` false only `what` is told, and where the nearest texel settles that, by it: it weighs LEAST_VALID or more.
MapLookup look_up_depth(vec2 on_square, bool weighs) {
    vec3 direction = from_station + on_square.x * map_u + on_square.y * map_v;
    float away = length(direction), height = float(map_place.y);
    MapLookup found = MapLookup(chart_of(direction), project(direction, height), vec4(0.0), HIDDEN);
    if (map_depth.x > MOST_OF_DISTANCE * away) return found;
    float code = 1.0 + log(away * map_depth.y) * map_depth.z, off = map_depth.x / away * map_depth.z;
    ivec2 corner = ivec2(floor(found.at - 0.5));
    vec2 share = found.at - 0.5 - vec2(corner);
    if (!weighs) {
        ivec2 nearest = texel_at(ivec2(floor(found.at)), found.chart, map_place.y);
        float there = float(texelFetch(map_depths, ivec3(nearest, map_place.x), 0).r);
        if (there != 0.0 && abs(there - code) <= off) {
            found.what = SHOWN;
            return found;
        }
    }
    Taps taps = taps_at(corner, found.chart, map_place.y);
    float before = 0.0;
    for (int i = 0; i < 4; ++i) {
        ivec2 tap = ivec2(i & 1, i >> 1);
        float weight = (tap.x == 1 ? share.x : 1.0 - share.x) * (tap.y == 1 ? share.y : 1.0 - share.y);
        float there = float(texelFetch(map_depths, ivec3(taps.at[i], map_place.x), 0).r);
        if (there == 0.0) continue;
        if (abs(there - code) <= off) found.weight[i] = weight;
        else if (there < code) before += weight;
    }
    if (dot(found.weight, vec4(1.0)) >= LEAST_VALID) found.what = SHOWN;
    else found.what = before >= LEAST_VALID ? HIDDEN : FREE;
    return found;
}

#ifdef MAP_COLORS
vec3 look_up_color(MapLookup found) {
    int level = int(map_depth.w);
    vec2 at = found.at * exp2(-float(level)) - 0.5;
    ivec2 corner = ivec2(floor(at));
    vec2 share = at - vec2(corner);
    int height = map_place.y;
    Taps taps = taps_at(corner, found.chart, height >> level);
    ivec2 begin = level == 0 ? ivec2(0) : ivec2(3 * height - (3 * height >> (level - 1)), 2 * height);
    vec4 sum = vec4(0.0);
    for (int i = 0; i < 4; ++i) {
        ivec2 tap = ivec2(i & 1, i >> 1);
        if (level == 0 && found.weight[i] == 0.0) continue;
        vec4 texel = texelFetch(map_colors, ivec3(begin + taps.at[i], map_place.x), 0);
        float weight = (tap.x == 1 ? share.x : 1.0 - share.x) * (tap.y == 1 ? share.y : 1.0 - share.y) * texel.a;
        sum += weight * vec4(texel.rgb, 1.0);
    }
    return sum.rgb / max(sum.a, 1e-6);
}
#endif
