// Position and normal of a splat as a cell over its chunk's quadric: numbers as storage/packed/quadrics.py packs them, decoded as
// pipeline/geometry/quadrics/frames.py does. Needs view.glsl, splat_word and `boxes` with BOX_WORDS a chunk: origin in the group's box (0 and 1) and
// step (1); turn, bits of numbers and low bits of the normals' map (2); curve and high parts of cells (3); low parts of cells and scale of sizes (4);
// slopes of normals (5); where their steps begin, their lean and high bits of the first bit in the group's words and of the map (6); steps of normals
// and low bits of the first bit (7).

#include "running_counts.glsl"

const uint LEAST_BITS = 16u;  // of a number, which the lowest part has

// Ones of each pair, of each four and of each eight bits of a word.
uvec3 ones_in(uint word) {
    uint pairs = word - (word >> 1 & 0x55555555u), fours = (pairs & 0x33333333u) + (pairs >> 2 & 0x33333333u);
    return uvec3(pairs, fours, fours + (fours >> 4) & 0x0F0F0F0Fu);
}

// The 32 bits that begin `bit` bits after a word of the stream.
uint word_at(uint first, uint bit) {
    uint at = first + (bit >> 5), shift = bit & 31u;
    return splat_word(at) >> shift | splat_word(at + 1u) << (31u - shift) << 1;
}

// The position of the highest bit of a number below 2^24, plus 1; of 0 anything.
uint bit_length(uint n) { return (floatBitsToUint(float(n)) >> 23) - 126u; }

// How many bits of its numbers a batch of n splats keeps in unary.
uint high_bits(uint n, uint bits) {
    if (n < 5u) return 0u;
    uint high = min(bit_length(n - 1u), bits - LEAST_BITS);
    return n * high > n + (1u << high) ? high : 0u;
}

// The number of a splat: its bits above the lowest 16, and these.
uvec2 number_of(uint splat) {
    uint chunk = splat / CHUNK, place = splat % CHUNK, box = chunk * BOX_WORDS, bits = (boxes[box + 2u] >> 24 & 31u) + LEAST_BITS;
    uint first = splat_word(chunk / CHUNKS_PER_GROUP * GROUP_WORDS), at = (boxes[box + 6u] >> 26 & 31u) << 16 | boxes[box + 7u] >> 16, begin = 0u, n = 0u, high = 0u;
    for (uint batch_above = 1u; batch_above <= scene.n_batches; ++batch_above) {
        uint end = counted(chunk, batch_above);
        if (chunk % CHUNKS_PER_GROUP > 0u) end -= counted(chunk - 1u, batch_above);
        n = end - begin;
        high = high_bits(n, bits);
        if (place < end) break;
        at += n * (bits - high) + (high > 0u ? n + (1u << high) : 0u);
        begin = end;
    }
    uint rank = place - begin, low = bits - high, top = 0u;
    if (high > 0u) {  // the bit of its vector that is the one after `rank` others
        uint left = rank, word_of = first + (at >> 5), word = splat_word(word_of) & 0xFFFFFFFFu << (at & 31u);
        uvec3 ones = ones_in(word);
        for (uint i = 0u; i < 8u && ones.z * 0x01010101u >> 24 <= left; ++i) {
            left -= ones.z * 0x01010101u >> 24;
            word = splat_word(++word_of);
            ones = ones_in(word);
        }
        uint bit = 0u, here = ones.z + (ones.z >> 8) & 0xFFu;
        if (here <= left) left -= here, bit = 16u;
        if ((here = ones.z >> bit & 0xFFu) <= left) left -= here, bit += 8u;
        if ((here = ones.y >> bit & 0xFu) <= left) left -= here, bit += 4u;
        if ((here = ones.x >> bit & 3u) <= left) left -= here, bit += 2u;
        if ((word >> bit & 1u) <= left) bit += 1u;
        top = (word_of - first << 5) + bit - at - rank;
        at += n + (1u << high);
    }
    at += rank * low;
    uint above = word_at(first, at + LEAST_BITS) & ((1u << (low - LEAST_BITS)) - 1u);
    return uvec2(top << (low - LEAST_BITS) | above, word_at(first, at) & 0xFFFFu);
}

uvec2 cells_of(uint box) {
    uint low = boxes[box + 4u], high = boxes[box + 3u] >> 24;
    return (uvec2(low, low >> 8) & 0xFFu | uvec2(high << 8 & 0xF00u, high << 4 & 0xF00u)) + 1u;
}

// What left the octahedral map of so many steps over an edge, where it comes in again.
ivec2 wrapped(ivec2 p, int steps) {
    if (abs(p.x) > steps) p = ivec2(p.x > 0 ? 2 * steps - p.x : -2 * steps - p.x, -p.y);
    if (abs(p.y) > steps) p = ivec2(-p.x, p.y > 0 ? 2 * steps - p.y : -2 * steps - p.y);
    return p;
}

// Of a number the remainder by the first radix, and of its quotient the remainder and the quotient by the second.
uvec3 digits_of(uint number, uvec2 radix) {
    uint first = number / radix.x, second = first / radix.y;
    return uvec3(number - first * radix.x, first - second * radix.y, second);
}

// A number above its lowest 16 bits, and these, by a divisor of at most 16 bits: the quotient so, and the remainder.
uvec3 divided(uvec2 number, uint divisor) {
    uint above = number.x / divisor, rest = (number.x - above * divisor) << 16 | number.y, below = rest / divisor;
    return uvec3(above, below, rest - below * divisor);
}

// The normal of a splat, as a point of its chunk's octahedron, the code of its size, and its cell as one number: the
// quotient of its number by sizes and steps of normals, which are its lowest digits.
uint read_number(uint splat, out ivec3 normal, out uint size) {
    uint box = splat / CHUNK * BOX_WORDS;
    uvec2 number = number_of(splat), steps = (uvec2(boxes[box + 7u]) >> uvec2(0u, 8u) & 0xFFu) + 1u, cells = cells_of(box);
    size = 0u;
#ifdef SIZE_BITS
    uvec3 quotient = divided(number, sizes_of(box));
    number = quotient.xy;
    size = quotient.z;
#endif
    uvec3 by_normals = divided(number, steps.x * steps.y);
    uint cell = (by_normals.x << 16) + by_normals.y, which = by_normals.z, low = boxes[box + 6u];
    ivec2 across = ivec2(2u * digits_of(cell, cells).xy + 1u) - ivec2(cells);
    ivec4 slope = bytes_of(boxes[box + 5u]);
    ivec2 sloped = ivec2(slope.x * across.x + slope.y * across.y, slope.z * across.x + slope.w * across.y) >> 8;
    ivec2 begin = ivec2(low & 0x1FFu, low >> 9 & 0x1FFu) - 256;
    uint row = which / steps.x;
    ivec2 digit = ivec2(which - row * steps.x, row);
    digit.y += (int(low << 6) >> 24) * digit.x >> 6;
    int map = 175 - 8 * int(boxes[box + 2u] >> 29 | low >> 28 & 8u);
    normal = octahedron_of(wrapped(clamp(begin + digit + sloped, -2 * map, 2 * map), map), map);
    return cell;
}

uint read_splat(uint splat, out ivec3 normal) {
    uint size;
    return read_number(splat, normal, size);
}

#ifdef SIZE_BITS
uint size_code(uint splat) { return divided(number_of(splat), sizes_of(splat / CHUNK * BOX_WORDS)).z; }
#endif

// From the origin of its chunk's frame, along the file's axes.
vec3 place_in_frame(uint box, uint code) {
    uvec2 cells = cells_of(box);
    uvec3 cell = digits_of(code, cells);
    vec2 across = vec2(2u * cell.xy + 1u) - vec2(cells);
    vec3 curve = vec3(bytes_of(boxes[box + 3u]).xyz) / float(1u << (bit_length(max(cells.x, cells.y)) + 7u));
    float height = curve.x * across.x * across.x + curve.y * across.x * across.y + curve.z * across.y * across.y;
    vec3 along = (vec3(cell) + vec3(0.5, 0.5, 0.5 + height)) * uintBitsToFloat(boxes[box + 1u] & 0x7FFF0000u);
    vec4 turn = normalize(vec4(bytes_of(boxes[box + 2u]).xyz, 117));
    return turned_by(turn, along);
}
