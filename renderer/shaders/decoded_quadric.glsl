layout(std430, binding = 19) readonly buffer DecodedSplats { uvec4 decoded_splats[]; };  // of decode_quadrics.comp.glsl
uniform uint first_decoded;

// The normal of a splat, as a point of an octahedron, and where it was decoded to.
uint read_splat(uint splat, out ivec3 normal) {
    uint code = splat - first_decoded, word = decoded_splats[code].w;
    normal = ivec3(int(word << 23) >> 23, int(word << 14) >> 23, int(word << 5) >> 23);
    return code;
}

#ifdef SIZE_BITS
uint size_code(uint splat) { return decoded_splats[splat - first_decoded].w >> 27; }
#endif

vec3 place_in_frame(uint box, uint code) { return uintBitsToFloat(decoded_splats[code].xyz); }
