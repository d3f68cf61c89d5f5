// Where a splat lies against the station whose map textures it, for station_map.glsl. Needs view.glsl, splat_geometry.glsl.

#include "looked_up.glsl"

const float SHARE_OF_DISTANCE = 0.005, SHARE_OF_RADIUS = 0.5, STEEPEST_SLOPE = 10.0, MOVED_TEXELS = 0.5;  // of pipeline/maps/sample.py

flat out vec3 from_station;  // the middle of the splat's square
flat out vec3 map_u, map_v;  // its tangents, a half side long; world axes
#ifdef ELLIPSOID
flat out vec3 map_w;         // the third half axis
#endif
flat out vec4 map_depth;     // how far off its own a distance may lie; 1 / nearest, codes an e-fold, mip level
flat out vec4 map_eye;       // the eye; whether fragments move, by more than MOVED_TEXELS
flat out ivec2 map_place;    // layer, -1 where no map shows the splat, and height
flat out float map_share;    // of its colour and outline that is looked up

vec3 camera_to_world(vec3 v) { return v.x * view.camera_x.xyz + v.y * view.camera_y.xyz + v.z * view.camera_z.xyz; }

// `u`, `v`: tangents of the square, and its `middle`, in camera axes.
void set_map(uint splat, vec3 u, vec3 v, vec3 middle) {
    uint map;
    map_place = ivec2(-1, 1);
    map_share = share_looked_up(splat, middle, map);
    if (map_share == 0.0) return;
    uint at = map * MAP_WORDS;
    vec3 high = vec3(map_frames[at], map_frames[at + 1u], map_frames[at + 2u]);
    vec3 low = vec3(map_frames[at + 3u], map_frames[at + 4u], map_frames[at + 5u]);
    ivec3 normal;
    from_station = position_against(high, low, splat, read_splat(splat, normal));
    map_u = camera_to_world(u);
    map_v = camera_to_world(v);
    float height = map_frames[at + 6u], texel = PI / 2.0 / height, away = max(length(from_station), 1e-30);
    float along = abs(dot(from_station, normalize(cross(map_u, map_v))));
    float slope = min(sqrt(max(away * away - along * along, 0.0)) / max(along, 1e-30), STEEPEST_SLOPE);
    map_depth = vec4(1.5 * SHARE_OF_DISTANCE * away + SHARE_OF_RADIUS * radius_of(splat) + texel * away * slope, map_frames[at + 7u], map_frames[at + 8u], 0.0);
    vec3 to_eye = camera_to_world(middle);
    float sine = length(cross(from_station, to_eye)) / max(away * length(to_eye), 1e-30);
    map_eye = vec4(from_station - to_eye, map_depth.x * sine > MOVED_TEXELS * texel * away ? 1.0 : 0.0);
    map_place = ivec2(int(map), int(height));
}

const float MAP_COARSEST = 4.0;     // mip level: heights are whole numbers of 16 rows
const float MAP_TO_COARSER = 0.45;  // as TO_COARSER of attribute.vert.glsl

// The mip level, of a square between the tangents that covers so many pixels; negative where that is not known.
void set_map_level(float area_px) {
    if (map_place.x < 0) return;
    float texel = PI / 2.0 / float(map_place.y) * length(from_station);
    float area_texels = abs(dot(from_station, cross(map_u, map_v))) / max(length(from_station) * texel * texel, 1e-30);
    map_depth.w = min(floor(mip_level(0.5 * area_texels, area_px) + MAP_TO_COARSER), MAP_COARSEST);
}

// Where programs have splats of their own: LOOKED_UP 1 those of coarser levels, 2 those of the finest, 3 those whose fragments move, too.
bool is_of_other_program() {
#ifdef LOOKED_UP
    return map_place.x < 0 || LOOKED_UP != (map_depth.w > 0.0 ? 1 : map_eye.w == 0.0 ? 2 : 3);
#else
    return false;
#endif
}
