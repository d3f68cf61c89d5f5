#include "srgb.glsl"

const float LEAST_WEIGHT = 1.0 / 1024.0;  // below it the 16-bit sums hold no colour worth showing
#ifdef WATCHED
const float OVERDRAWN = 16.0;  // above it 16-bit sums may be off by 1/255, see renderer/splats/targets.py
#endif
layout(binding = 0) uniform sampler2D sums;
#ifdef SMOOTH
#include "lamp.glsl"
layout(binding = 1) uniform sampler2D normals;  // normal times weight, weight; in camera axes

vec3 lit(vec3 linear) { return under_lamp(linear, texelFetch(normals, ivec2(gl_FragCoord.xy), 0).xyz); }
#else
vec3 lit(vec3 linear) { return linear; }
#endif
out vec4 color;  // sRGB, and 1 where the picture is covered, 0.5 where it is overdrawn

void main() {
    vec4 sum = texelFetch(sums, ivec2(gl_FragCoord.xy), 0);
    if (!(sum.a >= LEAST_WEIGHT)) {
        color = vec4(0.0);
        return;
    }
#ifdef WATCHED
    float covered = sum.a <= OVERDRAWN ? 1.0 : 0.5;
#else
    const float covered = 1.0;
#endif
    color = vec4(to_srgb(clamp(lit(sum.rgb / sum.a), 0.0, 1.0)), covered);
}
