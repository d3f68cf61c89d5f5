// A clipline's code of 3 x 4 bits as a, b, c, as pipeline/geometry/cliplines.py decodes it.

vec3 decode_clipline(uint code) {
    return vec3(uvec3(code, code >> 4, code >> 8) & 15u) / 7.0 - 1.0;
}
