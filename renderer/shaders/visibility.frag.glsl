#include "splat_fragment.glsl"
#ifdef MAPPED
#include "station_map.glsl"
#endif

// The squared distance up to which a splat hides what lies behind it. Out to its rim, where it weighs nothing, pixels stay empty that what lies
// behind would fill, and colours of rims stand alone. PSNR to the photographs, mean of four views of 1,024 px, fountain_p11 and monstree (draft):
// 1 28.58 and 23.08 dB, 0.9 28.66 and 23.11, 0.8 28.74 and 23.14, 0.7 28.82 and 23.16, 0.5 28.89 and 23.19, but two views of the first fall.
const float HIDES = 0.7;

// A splat below a pixel hides half a pixel about its centre, not all that it is drawn on, or what is far would grow by a pixel to all sides. PSNR to
// pictures drawn four times as large (a quarter of fountain_p11, monstree, conference_room; docs/PERFORMANCE.md): 30.9, 28.0, 23.9 dB with 0.7,
// 31.8, 29.0, 25.1 with 0.5, 32.7, 30.3, 26.6 with 0.3, 33.1, 30.9, 27.3 with 0.2.
const float HIDES_PX2 = 0.25;

bool hides() { return dot(place.xy, place.xy) < HIDES || dot(place.zw, place.zw) < HIDES_PX2; }

void main() {
    float d2 = squared_distance();
    if (outside(d2) || !hides()) discard;
#ifdef ELLIPSOID
    set_depth(d2);
#endif
#ifdef MAPPED
#ifndef ELLIPSOID
    gl_FragDepth = gl_FragCoord.z;
#endif
    if (map_place.x >= 0) {
        uint what = look_up_depth().what;
        if (is_no_fragment(what, d2)) discard;
        if (is_second_tier(what, d2)) gl_FragDepth *= BEHIND_ALL;
    }
#endif
}
