#include "splat_fragment.glsl"
#if defined(N_ATOMS) || defined(PAGES)
#include "view.glsl"
#include "srgb.glsl"
#endif
#ifdef N_ATOMS
#include "atom_texture.glsl"
#elif defined(MAPPED)
#define MAP_COLORS
#include "srgb.glsl"
#include "station_map.glsl"
#endif
#ifdef PAGES
#include "pages.frag.glsl"
#ifndef ELLIPSOID
layout(early_fragment_tests) in;  // what is hidden asks for no page
#endif

// From which deficit on atoms, where there are some, show more than the page there is: 3.5 to 6 dB on fountain_p11.
#ifdef N_ATOMS
const float DEFICIT_SHOWN = 2.0;
#else
const float DEFICIT_SHOWN = 1e9;
#endif
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
#ifdef PAGES
    vec4 paged = paged_color();
    if (!in_view()) {  // the margin asks for pages, and is not shown
        weighted = vec4(0.0);
        ADD_NORMAL(0.0)
        return;
    }
#endif
#ifdef N_ATOMS
    vec3 color = to_linear(clamp(average + sum_of_atoms(on_square()), 0.0, 1.0));
#elif defined(MAPPED)
    vec3 color = average;
#ifndef ELLIPSOID
    gl_FragDepth = gl_FragCoord.z;
#endif
    if (map_place.x >= 0) {
        MapLookup found = look_up_depth();
        if (is_no_fragment(found.what, d2)) discard;
        if (found.what == SHOWN) color = mix(average, look_up_color(found), map_share);
        if (is_second_tier(found.what, d2)) gl_FragDepth *= BEHIND_ALL;
    }
    color = to_linear(color);
#else
    vec3 color = average;
#endif
#ifdef PAGES
    if (paged.a >= 0.0 && paged.a < DEFICIT_SHOWN) color = to_linear(paged.rgb);
#endif
    float weight = share * (1.0 - d2);
    weighted = vec4(BY_LAMP(color), 1.0) * weight;
    ADD_NORMAL(weight)
}
