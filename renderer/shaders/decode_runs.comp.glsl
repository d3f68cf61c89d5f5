// Runs of cells into positions and normals: a section of runs a workgroup, a run an invocation. All in whole numbers, but one product a
// coordinate at the end, so that the bits are those of pipeline/geometry/runs/codes.py.

layout(local_size_x = 256) in;

#include "bits.glsl"

struct Section { int column, row, slice; uint first_run, first_step, first_word, bits; };  // pipeline/geometry/runs/starts.py
layout(std430, binding = 0) readonly buffer Sections { Section sections[]; };  // one more at the end, of the ends
layout(std430, binding = 1) readonly buffer Starts { uint starts[]; };
layout(std430, binding = 2) readonly buffer Steps { uint steps[]; };                 // four a word
layout(std430, binding = 3) readonly buffer Codebook { ivec2 codebook[32]; };
layout(std430, binding = 4) writeonly buffer Splats { uint splats[]; };  // x, y, z as floats; octahedral a in the lowest byte, then b
#ifdef BY_PLACE
layout(std430, binding = 5) readonly buffer Places { uint places[]; };  // the splat that each cell is, of its chunk, four a word
uint place_of(uint cell) { return (cell & ~127u) + ((places[cell >> 2] >> (8u * (cell & 3u))) & 127u); }
#else
uint place_of(uint cell) { return cell; }
#endif
uniform vec3 pitch;  // half a column, a third of a row, a slice
uniform vec3 turn_x, turn_y, turn_z;  // rows of the matrix to the file's axes

float along(vec3 row, vec3 p) {
    precise vec3 products = row * p;
    precise float sum = products.x + products.y;
    precise float result = sum + products.z;
    return result;
}

shared uint ends[256];  // running sums of the lengths of the section's runs

uint bits_of(Section own, int field) { return bitfieldExtract(own.bits, 4 * field, 4); }

// Column, row, slice, length - 1, and the normal, of the section's run `lane`.
int[6] start_of(Section own, uint lane) {
    uint at = 0u;
    for (int i = 0; i < 6; ++i) at += lane * bits_of(own, i);
    int found[6] = int[6](bitfieldExtract(own.column, 0, 22), bitfieldExtract(own.row, 0, 22), bitfieldExtract(own.slice, 0, 22), 0,
                          bitfieldExtract(own.column, 22, 8), bitfieldExtract(own.row, 22, 8));
    for (int i = 0; i < 6; ++i) {
        found[i] += int(READ_BITS(starts, own.first_word, at, bits_of(own, i)));
        at += bits_of(own, i);
    }
    return found;
}

ivec2 wrapped(ivec2 p) {
    if (abs(p.x) > 127) p = ivec2(p.x > 0 ? 254 - p.x : -254 - p.x, -p.y);
    if (abs(p.y) > 127) p = ivec2(-p.x, p.y > 0 ? 254 - p.y : -254 - p.y);
    return p;
}

void write_cell(uint cell, ivec3 at, ivec2 normal) {
    ivec3 units = ivec3(2 * at.x + ((at.y ^ at.z) & 1), 3 * at.y + (at.z & 1), at.z);
    precise vec3 position = vec3(units) * pitch;
    uint first = 4u * place_of(cell);
    splats[first] = floatBitsToUint(along(turn_x, position));
    splats[first + 1u] = floatBitsToUint(along(turn_y, position));
    splats[first + 2u] = floatBitsToUint(along(turn_z, position));
    splats[first + 3u] = uint(normal.x & 255) | uint(normal.y & 255) << 8;
}

void main() {
    Section own = sections[gl_WorkGroupID.x], next = sections[gl_WorkGroupID.x + 1u];
    uint lane = gl_LocalInvocationID.x, run = own.first_run + lane;
    bool active_lane = run < next.first_run;
    int start[6] = start_of(own, active_lane ? lane : 0u);
    uint n_cells = active_lane ? uint(start[3]) + 1u : 0u;
    ends[lane] = n_cells;
    for (uint reach = 1u; reach < 256u; reach <<= 1) {
        barrier();
        uint below = lane >= reach ? ends[lane - reach] : 0u;
        barrier();
        ends[lane] += below;
    }
    if (!active_lane) return;
    uint before = ends[lane] - n_cells;                 // cells of the section's earlier runs
    uint cell = own.first_run + own.first_step + before;  // a cell for each run and each step
    uint byte_ = own.first_step + before - lane;
    ivec3 at = ivec3(start[0], start[1], start[2]);
    ivec2 normal = ivec2(start[4], start[5]);
    write_cell(cell, at, normal);
    uint direction = 0u;
    for (uint i = 1u; i < n_cells; ++i, ++byte_) {
        uint code = bitfieldExtract(steps[byte_ >> 2], int(8u * (byte_ & 3u)), 8);
        direction = (direction + (code & 7u)) % 6u;
        int q = (at.y ^ at.z) & 1;
        int side = direction == 0u ? 1 : direction == 3u ? -1 : direction == 1u || direction == 5u ? q : q - 1;
        int rise = direction == 0u || direction == 3u ? 0 : direction < 3u ? 1 : -1;
        at += ivec3(side, rise, 0);
        normal = wrapped(normal + codebook[code >> 3]);
        write_cell(cell + i, at, normal);
    }
}
