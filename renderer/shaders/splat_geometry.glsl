// Position, tangent frame and average colour of a splat, decoded as pipeline/geometry/{positions,normals,frame}.py and
// pipeline/texture/colors.py do. Needs view.glsl.

ivec4 bytes_of(uint word) { return ivec4(int(word << 24) >> 24, int(word << 16) >> 24, int(word << 8) >> 24, int(word) >> 24); }

vec3 turned_by(vec4 q, vec3 p) { return p + 2.0 * cross(q.xyz, cross(q.xyz, p) + q.w * p); }

layout(std430, binding = 1) readonly buffer Boxes { uint boxes[]; };  // BOX_WORDS a chunk: low, size, bits and sizes, those of its colours, then the sizes of its splats
#ifdef QUADRICS
layout(std430, binding = 0) readonly buffer Splats { uint splats[]; };  // of each group its first word, where its box begins and the unit there; then the words of all numbers
const uint GROUP_WORDS = 5u;

uint splat_word(uint at) { return splats[at]; }

layout(std430, binding = 10) readonly buffer Colors { uint colors[]; };  // in boxes, or 3 B a splat
const uint COLOR_WORD = 8u;
const uint SCALE_WORD = 4u;  // its upper half has the scale of sizes
#ifdef COLOR_BOXES
#include "bits.glsl"
const uint SIZE_WORD = 12u;
#else
const uint SIZE_WORD = 8u;
#endif
#elif defined(RUNS)
const uint COLOR_WORD = 7u;
layout(std430, binding = 0) readonly buffer Splats { uint splats[]; };  // decoded: x, y, z as floats, a word of normal
layout(std430, binding = 10) readonly buffer Colors { uint colors[]; };  // in boxes, or 3 B a splat
#ifdef COLOR_BOXES
#include "bits.glsl"
const uint SIZE_WORD = 11u;
#else
const uint SIZE_WORD = 7u;
#endif

uvec2 splat_words(uint splat) {
    uint word = splats[4u * splat + 3u];
    return uvec2(word << 24, word >> 8);
}

vec3 position_against(vec3 place_high, vec3 place_low, uint splat, uint code) {
    uint first = 4u * splat;
    return against(place_high, place_low, uintBitsToFloat(uvec3(splats[first], splats[first + 1u], splats[first + 2u])));
}
#elif defined(COLOR_BOXES)
#include "bits.glsl"
const uint COLOR_WORD = 7u;
layout(std430, binding = 0) readonly buffer Splats { uint splats[]; };  // 3 B position, 2 B normal
layout(std430, binding = 10) readonly buffer Colors { uint colors[]; };
const uint SIZE_WORD = 11u;

uvec2 splat_words(uint splat) {
    uint first = splat * 5u;
    uint shift = 8u * (first & 3u), word = splats[first >> 2], next = splats[(first >> 2) + 1u];
    return uvec2(word >> shift | next << (31u - shift) << 1, next >> shift);
}
#else
layout(std430, binding = 0) readonly buffer Splats { uvec2 splats[]; };  // 3 B position, 2 B normal, 3 B color
const uint SIZE_WORD = 7u;

uvec2 splat_words(uint splat) { return splats[splat]; }
#endif

#ifndef GROWTH_OF
#define GROWTH_OF(group) 1.0
#endif

#ifndef QUADRICS
const uint SCALE_WORD = 6u;  // its upper half has the scale of sizes
#ifdef SIZE_BITS
#include "bits.glsl"
const uint BOX_WORDS = SIZE_WORD + 4u * uint(SIZE_BITS);

uint size_code(uint splat) {
    return READ_BITS(boxes, splat / CHUNK * BOX_WORDS + SIZE_WORD, splat % CHUNK * uint(SIZE_BITS), uint(SIZE_BITS));
}

uint sizes_of(uint box) { return 1u << uint(SIZE_BITS); }
#else
const uint BOX_WORDS = SIZE_WORD;
#endif
#endif

struct Disc {
    vec3 centre;  // in camera axes, against the eye
    vec3 u, v;    // tangents in camera axes, one radius long
    float radius;
};

// The point on the octahedron |x| + |y| + |z| = steps that a code names.
ivec3 octahedron_of(ivec2 code, int steps) {
    int c = steps - abs(code.x) - abs(code.y);
    if (c >= 0) return ivec3(code, c);
    return ivec3(code.x >= 0 ? steps - abs(code.y) : abs(code.y) - steps,
                 code.y >= 0 ? steps - abs(code.x) : abs(code.x) - steps, c);
}

#ifdef QUADRICS
const uint BOX_WORDS = SIZE_WORD;
#ifdef SIZE_BITS

// How many values codes of sizes have in a chunk.
uint sizes_of(uint box) {
    uint scale = boxes[box + SCALE_WORD] >> 16;
    return min(1u + (8u * ((scale >> 8) - (scale & 0xFFu)) + 14u) / 15u, 16u);
}
#endif
#ifdef DECODED
#include "decoded_quadric.glsl"
#else
#include "quadric.glsl"
#endif

// Against a place that is the sum of two floats, part by part.
vec3 position_against(vec3 place_high, vec3 place_low, uint splat, uint code) {
    uint box = splat / CHUNK * BOX_WORDS;
    uint head = splat / GROUP * GROUP_WORDS;
    vec3 low = uintBitsToFloat(uvec3(splat_word(head + 1u), splat_word(head + 2u), splat_word(head + 3u)));
    vec3 origin = vec3(boxes[box] & 0xFFFFu, boxes[box] >> 16, boxes[box + 1u] & 0xFFFFu) * uintBitsToFloat(splat_word(head + 4u));
    return against(place_high, place_low, low) + (origin + place_in_frame(box, code));
}
#elif !defined(RUNS)
// Against a place that is the sum of two floats, part by part.
vec3 position_against(vec3 place_high, vec3 place_low, uint splat, uint code) {
    uint box = splat / CHUNK * BOX_WORDS;
    vec3 low = uintBitsToFloat(uvec3(boxes[box], boxes[box + 1u], boxes[box + 2u]));
    vec3 size = uintBitsToFloat(uvec3(boxes[box + 3u], boxes[box + 4u], boxes[box + 5u]));
    uvec2 bits_xy = (uvec2(boxes[box + 6u]) >> uvec2(0u, 8u)) & 0xFFu;
    uvec3 bits = uvec3(bits_xy, 24u - bits_xy.x - bits_xy.y);
    uvec3 cells = uvec3(1u) << bits;
    uvec3 cell = (uvec3(code) >> uvec3(0u, bits.x, bits.x + bits.y)) & (cells - 1u);
    return against(place_high, place_low, low) + (vec3(cell) + 0.5) * (size / vec3(cells));
}
#endif

#ifndef QUADRICS
// The normal of a splat, as a point of the octahedron, and its cell as one number.
uint read_splat(uint splat, out ivec3 normal) {
    uvec2 words = splat_words(splat);
    normal = octahedron_of(ivec2(int(words.x) >> 24, int(words.y << 24) >> 24), 127);
    return words.x & 0xFFFFFFu;
}
#endif

// As pipeline/geometry/sizes.py decodes it.
float radius_of(uint splat) {
#ifdef SIZE_BITS
    uint box = splat / CHUNK * BOX_WORDS;
    float low = float(boxes[box + SCALE_WORD] >> 16 & 0xFFu), high = float(boxes[box + SCALE_WORD] >> 24);
    float at = low + (high - low) * float(size_code(splat)) / float(max(sizes_of(box), 2u) - 1u);
    return scene.radius * exp2((at - 128.0) / 16.0) * GROWTH_OF(splat / GROUP);
#else
    return scene.radius * GROWTH_OF(splat / GROUP);
#endif
}

vec3 decode_position(uint splat, uint code) { return position_against(view.eye_high.xyz, view.eye_low.xyz, splat, code); }

int dot_of(ivec3 a, ivec3 b) {
    ivec3 products = a * b;
    return products.x + products.y + products.z;
}

void decode_frame(ivec3 point, out vec3 u, out vec3 v) {
    ivec3 up = scene.up.xyz;
    int along_up = dot_of(point, up);
    bool near_pole = 100u * uint(along_up * along_up) > 81u * uint(dot_of(point, point) * dot_of(up, up));
    vec3 reference = vec3(near_pole ? scene.ahead.xyz : up);
    vec3 normal = normalize(vec3(point));
    u = normalize(cross(reference, normal));
    v = cross(normal, u);
}

Disc decode_disc(uint splat) {
    ivec3 normal;
    uint cell = read_splat(splat, normal);
    vec3 u, v;
    decode_frame(normal, u, v);
    float radius = radius_of(splat);
    return Disc(world_to_camera(decode_position(splat, cell)),
                world_to_camera(u) * radius, world_to_camera(v) * radius, radius);
}

#ifdef COLOR_BOXES
vec3 decode_color(uint splat) {
    uint box = splat / CHUNK * BOX_WORDS + COLOR_WORD;
    uint low_xy = boxes[box + 1u], low_z_size_xy = boxes[box + 2u], size_z_turn = boxes[box + 3u];
    vec3 low = vec3(int(low_xy << 16) >> 16, int(low_xy) >> 16, int(low_z_size_xy << 16) >> 16) / 32.0;
    uvec3 size_code = uvec3(low_z_size_xy >> 16, low_z_size_xy >> 24, size_z_turn) & 0xFFu;
    uvec3 bits = uvec3(max(ivec3(size_code) - COLOR_BOXES + 15, 0)) >> 4;
    uint width = bits.x + bits.y + bits.z;
    uint code = 0u;
    if (width > 0u) code = READ_BITS(colors, boxes[box], splat % CHUNK * width, width);  // else its word may be beyond the end
    uvec3 cells = uvec3(1u) << bits;
    uvec3 cell = (uvec3(code) >> uvec3(0u, bits.x, bits.x + bits.y)) & (cells - 1u);
    vec3 along = low + (vec3(cell) + 0.5) * (exp2(vec3(size_code) / 16.0 - 6.0) / vec3(cells));
    vec3 on_axes = turned_by(normalize(vec4(bytes_of(size_z_turn).yzw, 306)), along);
    vec3 color = on_axes.x * inversesqrt(3.0) * vec3(1.0, 1.0, 1.0) + on_axes.y * inversesqrt(2.0) * vec3(1.0, 0.0, -1.0)
               + on_axes.z * inversesqrt(6.0) * vec3(1.0, -2.0, 1.0);
    return clamp(color / 255.0, 0.0, 1.0);
}
#elif defined(RUNS) || defined(QUADRICS)
vec3 decode_color(uint splat) {
    uint at = 3u * splat, shift = 8u * (at & 3u);
    uint word = colors[at >> 2] >> shift | colors[(at >> 2) + 1u] << (31u - shift) << 1;
    return vec3((uvec3(word) >> uvec3(0u, 8u, 16u)) & 0xFFu) / 255.0;
}
#else
vec3 decode_color(uint splat) {
    return vec3((uvec3(splats[splat].y) >> uvec3(8u, 16u, 24u)) & 0xFFu) / 255.0;
}
#endif
