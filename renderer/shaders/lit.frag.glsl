// Light on splats: each lit by its own normal, or with SMOOTH the second target, of normals that are lit once they are blended.

#if defined(LIT) || defined(SMOOTH)
flat in vec3 normal;
#endif
#ifdef SMOOTH
layout(location = 1) out vec4 weighted_normal;
#define ADD_NORMAL(weight) weighted_normal = vec4(normal, 1.0) * (weight);
#else
#define ADD_NORMAL(weight)
#endif
#ifdef LIT
#ifdef SMOOTH
#define BY_LAMP(linear) (linear)
#else
#include "lamp.glsl"
#define BY_LAMP(linear) under_lamp(linear, normal)
#endif
#else
#define BY_LAMP(linear) (linear)
#endif
