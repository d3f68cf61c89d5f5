#include "srgb.glsl"

const float LEAST_WEIGHT = 1.0 / 1024.0;  // below it the 16-bit sums hold no colour worth showing
#ifdef WATCHED
const float OVERDRAWN = 16.0;  // above it 16-bit sums may be off by 1/255, see renderer/splats/targets.py
#endif
#ifndef TIMES
#define TIMES 1  // as large as the picture are the sums: a pixel is the mean of TIMES x TIMES of them
#endif
layout(binding = 0) uniform sampler2D sums;
#ifdef SMOOTH
#include "lamp.glsl"
layout(binding = 1) uniform sampler2D normals;  // normal times weight, weight; in camera axes

vec3 lit(vec3 linear, ivec2 at) { return under_lamp(linear, texelFetch(normals, at, 0).xyz); }
#else
vec3 lit(vec3 linear, ivec2 at) { return linear; }
#endif
out vec4 color;  // sRGB, and the share of the pixel that is covered; WATCHED 127/255 of it, and 128/255 where it is overdrawn

void main() {
    ivec2 first = TIMES * ivec2(gl_FragCoord.xy);
    vec3 light = vec3(0.0);
    float n_covered = 0.0, most = 0.0;
    for (int y = 0; y < TIMES; ++y) {
        for (int x = 0; x < TIMES; ++x) {
            ivec2 at = first + ivec2(x, y);
            vec4 sum = texelFetch(sums, at, 0);
            if (!(sum.a >= LEAST_WEIGHT)) continue;
            light += clamp(lit(sum.rgb / sum.a, at), 0.0, 1.0);
            n_covered += 1.0;
            most = max(most, sum.a);
        }
    }
    if (n_covered == 0.0) {
        color = vec4(0.0);
        return;
    }
    float covered = n_covered / float(TIMES * TIMES);
#ifdef WATCHED
    covered = covered * 127.0 / 255.0 + (most <= OVERDRAWN ? 0.0 : 128.0 / 255.0);
#endif
    color = vec4(to_srgb(light / n_covered), covered);
}
