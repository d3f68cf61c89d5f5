#include "srgb.glsl"

const float LEAST_WEIGHT = 1.0 / 1024.0;  // below it the 16-bit sums hold no colour worth showing
layout(binding = 0) uniform sampler2D sums;
out vec4 color;  // sRGB, and 1 where the picture is covered

void main() {
    vec4 sum = texelFetch(sums, ivec2(gl_FragCoord.xy), 0);
    color = sum.a >= LEAST_WEIGHT ? vec4(to_srgb(clamp(sum.rgb / sum.a, 0.0, 1.0)), 1.0) : vec4(0.0);
}
