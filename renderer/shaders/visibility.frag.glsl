#include "splat_fragment.glsl"

void main() {
    if (outside(squared_distance())) discard;
}
