// Position and tangent frame of a splat, decoded as pipeline/geometry/{positions,normals,frame}.py do.
// Needs view.glsl.

layout(std430, binding = 0) readonly buffer Splats { uvec2 splats[]; };  // 3 B position, 2 B normal, 3 B color
layout(std430, binding = 1) readonly buffer Boxes { uint boxes[]; };     // 7 words a chunk: low, size, bits

struct Disc {
    vec3 centre;  // in camera axes, against the eye
    vec3 u, v;    // tangents in camera axes, one radius long
};

vec3 decode_position(uint splat, uint code) {
    uint box = splat / CHUNK * 7u;
    vec3 low = uintBitsToFloat(uvec3(boxes[box], boxes[box + 1u], boxes[box + 2u]));
    vec3 size = uintBitsToFloat(uvec3(boxes[box + 3u], boxes[box + 4u], boxes[box + 5u]));
    uvec3 bits = (uvec3(boxes[box + 6u]) >> uvec3(0u, 8u, 16u)) & 0xFFu;
    uvec3 cells = uvec3(1u) << bits;
    uvec3 cell = (uvec3(code) >> uvec3(0u, bits.x, bits.x + bits.y)) & (cells - 1u);
    return against_eye(low) + (vec3(cell) + 0.5) * (size / vec3(cells));
}

ivec3 octahedron_of(ivec2 code) {
    int c = 127 - abs(code.x) - abs(code.y);
    if (c >= 0) return ivec3(code, c);
    return ivec3(code.x >= 0 ? 127 - abs(code.y) : abs(code.y) - 127,
                 code.y >= 0 ? 127 - abs(code.x) : abs(code.x) - 127, c);
}

int dot_of(ivec3 a, ivec3 b) {
    ivec3 products = a * b;
    return products.x + products.y + products.z;
}

void decode_frame(ivec2 code, out vec3 u, out vec3 v) {
    ivec3 point = octahedron_of(code);
    ivec3 up = scene.up.xyz;
    int along_up = dot_of(point, up);
    bool near_pole = 100 * along_up * along_up > 81 * dot_of(point, point) * dot_of(up, up);
    vec3 reference = vec3(near_pole ? scene.ahead.xyz : up);
    vec3 normal = normalize(vec3(point));
    u = normalize(cross(reference, normal));
    v = cross(normal, u);
}

Disc decode_disc(uint splat) {
    uvec2 words = splats[splat];
    ivec2 normal_code = ivec2(int(words.x) >> 24, int(words.y << 24) >> 24);
    vec3 u, v;
    decode_frame(normal_code, u, v);
    return Disc(world_to_camera(decode_position(splat, words.x & 0xFFFFFFu)),
                world_to_camera(u) * scene.radius, world_to_camera(v) * scene.radius);
}

vec3 decode_color(uint splat) {
    return vec3((uvec3(splats[splat].y) >> uvec3(8u, 16u, 24u)) & 0xFFu) / 255.0;
}
