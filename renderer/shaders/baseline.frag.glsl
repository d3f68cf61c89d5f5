#include "splat_fragment.glsl"
#include "srgb.glsl"

flat in vec3 average;
layout(location = 0) out vec4 weighted;
#include "lit.frag.glsl"
#ifdef PHOTO
layout(binding = 0) uniform sampler2D photo_texture;
flat in vec3 photo_centre, photo_u, photo_v;
#ifdef ELLIPSOID
flat in vec3 photo_w;
#endif
flat in float level;

vec3 photo_color() {
#ifdef ELLIPSOID
    vec3 at = on_ball();
    vec3 seen = photo_centre + mat3(photo_u, photo_v, photo_w) * at;
#else
    vec2 on_disc = clamp(place.xy, -1.0, 1.0);
    vec3 seen = photo_centre + on_disc.x * photo_u + on_disc.y * photo_v;
#endif
    if (seen.z <= 0.0) return average;  // behind the photo's camera
    return textureLod(photo_texture, seen.xy / seen.z / vec2(textureSize(photo_texture, 0)), level).rgb;
}
#else
vec3 photo_color() { return average; }
#endif

void main() {
    float d2 = squared_distance();
    if (outside(d2)) discard;
#ifdef ELLIPSOID
    set_depth(d2);
#endif
    weighted = vec4(to_linear(photo_color()), 1.0) * (1.0 - d2);
    ADD_NORMAL(1.0 - d2)
}
