// Which fragments belong to a splat, and with what weight: 1 - d^2, see splat_quad.glsl.

in vec4 place;
#ifdef CLIPLINE
flat in vec3 clipline;
#endif
#if defined(ELLIPSOID) || defined(MAPPED)
layout(depth_less) out float gl_FragDepth;  // reversed: what is written lies behind, so early tests against the splat's own are right
#endif
#ifdef MAPPED
flat in float map_share;  // of its colour and outline that is looked up in a map
#define CLIPPED_FROM (1.0 - map_share)  // small splats are not trimmed, see looked_up.glsl
#else
#define CLIPPED_FROM 0.0
#endif
#ifdef ELLIPSOID
#include "ellipsoid_fragment.glsl"
#endif

// Where on the splat's square its colour is found.
#ifdef ELLIPSOID
vec2 on_square() { return on_ball().xy; }
#else
vec2 on_square() { return place.xy; }
#endif

bool outside(float d2) {
#ifdef CLIPLINE
    if (d2 >= CLIPPED_FROM && dot(clipline, vec3(place.xy, 1.0)) < 0.0) return true;
#endif
    return d2 >= 1.0;
}

float squared_distance() { return min(dot(place.xy, place.xy), dot(place.zw, place.zw)); }
