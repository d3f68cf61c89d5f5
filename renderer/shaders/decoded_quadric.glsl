layout(std430, binding = 14) readonly buffer DecodedSplats { uvec4 decoded_splats[]; };  // of decode_quadrics.comp.glsl
uniform uint first_decoded;

// The octahedral normal of a splat, and where it was decoded to.
uint read_splat(uint splat, out ivec2 normal) {
    uint code = splat - first_decoded, word = decoded_splats[code].w;
    normal = ivec2(int(word << 24) >> 24, int(word << 16) >> 24);
    return code;
}

vec3 place_in_frame(uint box, uint code) { return uintBitsToFloat(decoded_splats[code].xyz); }
