// Of programs for splats that are not looked up.
#include "looked_up.glsl"
