#include "splat_fragment.glsl"
#ifdef N_ATOMS
#include "view.glsl"
#include "srgb.glsl"
#include "atom_texture.glsl"
#elif defined(MAPPED)
#define MAP_COLORS
#include "srgb.glsl"
#include "station_map.glsl"
#endif

flat in vec3 average;
#ifdef DETAIL
flat in float share;
#else
const float share = 1.0;
#endif
layout(location = 0) out vec4 weighted;  // linear light times weight, weight
#include "lit.frag.glsl"

void main() {
    float d2 = squared_distance();
    if (outside(d2)) discard;
#ifdef ELLIPSOID
    set_depth(d2);
#endif
#ifdef N_ATOMS
    vec3 color = to_linear(clamp(average + sum_of_atoms(on_square()), 0.0, 1.0));
#elif defined(MAPPED)
    vec3 color = average;
#ifndef ELLIPSOID
    gl_FragDepth = gl_FragCoord.z;
#endif
    if (map_place.x >= 0) {
        MapLookup found = look_up_depth(on_square());
        if (found.what == FREE) discard;
        if (found.what == SHOWN) color = look_up_color(found);
        else gl_FragDepth *= BEHIND_ALL;
    }
    color = to_linear(color);
#else
    vec3 color = average;
#endif
    float weight = share * (1.0 - d2);
    weighted = vec4(BY_LAMP(color), 1.0) * weight;
    ADD_NORMAL(weight)
}
