// Whether a splat is looked up in the map of a laser station. Needs view.glsl, splat_geometry.glsl, polar_capped.glsl.

layout(std430, binding = 12) readonly buffer SplatMaps { uint splat_maps[]; };  // a byte a splat: its map, IN_PART more from the front alone, 255 none
layout(std430, binding = 13) readonly buffer MapFrames { float map_frames[]; };  // MAP_WORDS a map, see renderer/splats/upload/maps.py
const uint MAP_WORDS = 9u;

// From which radius on the screen a splat is looked up: where the map has no more than so many texels a pixel, but not below the smaller and
// always from the larger radius. A smaller one is its mean colour, and up to RAMP times that radius something between, so that nothing pops.
// renderer/splats/upload/maps.py says the same.
const float TEXELS_A_PX = 2.0, SMALLEST_LOOKED_UP_PX = 2.5, ALWAYS_LOOKED_UP_PX = 16.0, RAMP = 1.25;

// Splats of which a map shows little, as of leaves, are looked up where they are seen from as their station saw them: cosines of the angle between
// both up to which all is, and from which on nothing. With 30 and 50 degrees near 1 of conference_room loses 0.7 dB.
const uint IN_PART = 128u;
const float FROM_THE_FRONT = 0.966, FROM_ASIDE = 0.866;  // 15 and 30 degrees

// How much of its colour and outline is looked up, 0 for a splat without a map; `middle`: where it lies, in camera axes.
float share_looked_up(uint splat, vec3 middle, out uint map) {
    map = splat_maps[splat >> 2] >> (8u * (splat & 3u)) & 0xFFu;
    if (map == 255u) return 0.0;
    bool in_part = map >= IN_PART;
    map &= IN_PART - 1u;
    uint at = map * MAP_WORDS;
    vec3 high = vec3(map_frames[at], map_frames[at + 1u], map_frames[at + 2u]);
    vec3 low = vec3(map_frames[at + 3u], map_frames[at + 4u], map_frames[at + 5u]);
    vec3 from_eye = (high - view.eye_high.xyz) + (low - view.eye_low.xyz);  // of the station
    vec3 from_station = middle - world_to_camera(from_eye);
    float away = max(length(from_station), 1e-30), radius = radius_of(splat), share = 1.0;
    if (in_part) {
        float cosine = dot(from_station, middle) / max(away * length(middle), 1e-30);
        share = clamp((cosine - FROM_ASIDE) / (FROM_THE_FRONT - FROM_ASIDE), 0.0, 1.0);
    }
    if (middle.z <= 0.0) return share;
    float texels = radius / away * map_frames[at + 6u] * (2.0 / PI), px = radius * max(view.lens.x, view.lens.y) / middle.z;
    float from_px = clamp(texels / TEXELS_A_PX, SMALLEST_LOOKED_UP_PX, ALWAYS_LOOKED_UP_PX);
    return share * clamp((px / from_px - 1.0) / (RAMP - 1.0), 0.0, 1.0);
}
