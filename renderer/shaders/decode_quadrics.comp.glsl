// Splats over quadrics decoded once for all passes and corners: a chunk a workgroup, a splat an invocation.

layout(local_size_x = 128) in;

#include "view.glsl"
#include "splat_geometry.glsl"

struct Draw { uint n_indices, n_instances, first_index, base_vertex, base_instance; };
layout(std430, binding = 8) readonly buffer Draws { Draw draws[]; };  // of cull.comp.glsl
layout(std430, binding = 19) writeonly buffer DecodedSplats { uvec4 decoded_splats[]; };  // from the chunk's origin, three floats; a point of an octahedron, 9 bits each, and the code of its size
uniform uint first_group;
uniform bool drawn_alone;  // of groups that are not, nothing is written

void main() {
    uint chunk = first_group * CHUNKS_PER_GROUP + gl_WorkGroupID.x, splat = chunk * CHUNK + gl_LocalInvocationID.x;
    if (drawn_alone && draws[scene.n_batches * scene.n_groups + chunk / CHUNKS_PER_GROUP].n_indices == 0u) return;
    if (splat >= scene.n_splats) return;
    ivec3 normal;
    uint size, cell = read_number(splat, normal, size);
    uint word = uint(normal.x & 511) | uint(normal.y & 511) << 9 | uint(normal.z & 511) << 18 | size << 27;
    decoded_splats[gl_GlobalInvocationID.x] = uvec4(floatBitsToUint(place_in_frame(chunk * BOX_WORDS, cell)), word);
}
