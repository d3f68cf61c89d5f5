// The clipline of a splat. Needs bits.glsl, groups.glsl.

#include "decode_clipline.glsl"

layout(std430, binding = 5) readonly buffer Cliplines { uint cliplines[]; };
flat out vec3 clipline;

vec3 read_clipline(uint group, uint row) {
    uint first_bit = (first_clipline(group) + row) * 12u;
    return decode_clipline(READ_BITS(cliplines, clipline_word(group), first_bit, 12u));
}
