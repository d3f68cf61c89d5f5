// The clipline of a splat, decoded as pipeline/geometry/cliplines.py does. Needs bits.glsl, groups.glsl.

layout(std430, binding = 5) readonly buffer Cliplines { uint cliplines[]; };
flat out vec3 clipline;

vec3 decode_clipline(uint code) {
    return vec3(uvec3(code, code >> 4, code >> 8) & 15u) / 15.0 * 2.0 - 1.0;
}

vec3 read_clipline(uint group, uint row) {
    uint first_bit = (first_clipline(group) + row) * 12u;
    return decode_clipline(READ_BITS(cliplines, clipline_word(group), first_bit, 12u));
}
