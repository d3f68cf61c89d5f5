#include "splat_fragment.glsl"

void main() {
    float d2 = squared_distance();
    if (outside(d2)) discard;
#ifdef ELLIPSOID
    set_depth(d2);
#endif
}
