// The second target of scenes that can be lit.

#ifdef LIT
flat in vec3 normal;
layout(location = 1) out vec4 weighted_normal;
#define ADD_NORMAL(weight) weighted_normal = vec4(normal, 1.0) * (weight);
#else
#define ADD_NORMAL(weight)
#endif
