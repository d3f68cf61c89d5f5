// Where a splat lies against the station whose map textures it, for station_map.glsl. Needs view.glsl, splat_geometry.glsl.

layout(std430, binding = 12) readonly buffer SplatMaps { uint splat_maps[]; };   // a byte a splat: its map, 255 none
layout(std430, binding = 13) readonly buffer MapFrames { float map_frames[]; };  // MAP_WORDS a map, see renderer/splats/maps.py
const uint MAP_WORDS = 9u;
const float SHARE_OF_DISTANCE = 0.005, SHARE_OF_RADIUS = 0.5, STEEPEST_SLOPE = 10.0;  // of pipeline/maps/sample.py

flat out vec3 from_station;  // the middle of the splat's square
flat out vec3 map_u, map_v;  // its tangents, a half side long; world axes
flat out vec4 map_depth;     // how far off its own a distance may lie; 1 / nearest, codes an e-fold, mip level
flat out ivec2 map_place;    // layer, -1 where no map shows the splat, and height

vec3 camera_to_world(vec3 v) { return v.x * view.camera_x.xyz + v.y * view.camera_y.xyz + v.z * view.camera_z.xyz; }

const float LOOKED_UP_FROM_PX = 2.5;  // of a splat's radius on the screen; a smaller one is its mean colour

// `u`, `v`: tangents of the square in camera axes; `z`: how far before the camera it lies.
void set_map(uint splat, vec3 u, vec3 v, float z) {
    uint map = splat_maps[splat >> 2] >> (8u * (splat & 3u)) & 0xFFu;
    map_place = ivec2(-1, 1);
    if (map == 255u || (z > 0.0 && radius_of(splat) * max(view.lens.x, view.lens.y) < LOOKED_UP_FROM_PX * z)) return;
    uint at = map * MAP_WORDS;
    vec3 high = vec3(map_frames[at], map_frames[at + 1u], map_frames[at + 2u]);
    vec3 low = vec3(map_frames[at + 3u], map_frames[at + 4u], map_frames[at + 5u]);
    ivec2 normal;
    from_station = position_against(high, low, splat, read_splat(splat, normal));
    map_u = camera_to_world(u);
    map_v = camera_to_world(v);
    float height = map_frames[at + 6u], texel = PI / 2.0 / height, away = max(length(from_station), 1e-30);
    float along = abs(dot(from_station, normalize(cross(map_u, map_v))));
    float slope = min(sqrt(max(away * away - along * along, 0.0)) / max(along, 1e-30), STEEPEST_SLOPE);
    map_depth = vec4(1.5 * SHARE_OF_DISTANCE * away + SHARE_OF_RADIUS * radius_of(splat) + texel * away * slope, map_frames[at + 7u], map_frames[at + 8u], 0.0);
    map_place = ivec2(int(map), int(height));
}

// Texels of the map that lie on a square of a half side, for `mip_level`.
float texels_of_map() {
    float texel = PI / 2.0 / float(map_place.y) * length(from_station);
    return abs(dot(from_station, cross(map_u, map_v))) / max(length(from_station) * texel * texel, 1e-30);
}
