// Of programs for splats that are not looked up.
#include "polar_capped.glsl"
#include "looked_up.glsl"
