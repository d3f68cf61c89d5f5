// Which splat a vertex draws. A draw's base vertex is its group's: gl_VertexID = (group, row in the draw, corner).
// Needs view.glsl.

#ifdef BY_BATCH
#include "running_counts.glsl"
uniform uint batch;

// The splat that stands at `row` among those of the batch in the group: its chunk by bisection, then its place there.
uint splat_of_row(uint group, uint row) {
    uint first = group * CHUNKS_PER_GROUP;
    uint low = first, high = last_chunk(group);
    while (low < high) {
        uint middle = (low + high) / 2u;
        if (counted_of(middle, batch) > row) high = middle;
        else low = middle + 1u;
    }
    if (low == first) return low * CHUNK + counted(low, batch) + row;
    return low * CHUNK + counted(low, batch) - counted(low - 1u, batch) + row - counted_of(low - 1u, batch);
}
#else
// One batch, or all batches alike: the rows of a draw are the splats of its group, one after the other.
const uint batch = 0u;

uint splat_of_row(uint group, uint row) { return group * GROUP + row; }
#endif

#ifdef LEADING
// Of rows that are the splats of a group: those in the batches below `n_leading`, which come first in each chunk.
#include "running_counts.glsl"
uniform uint n_leading;

bool is_drawn(uint splat) {
    uint chunk = splat / CHUNK;
    uint before = chunk % CHUNKS_PER_GROUP == 0u ? 0u : counted(chunk - 1u, n_leading);
    return splat % CHUNK < counted(chunk, n_leading) - before;
}
#else
#define is_drawn(splat) true
#endif

uint drawn_group() { return uint(gl_VertexID) / (4u * GROUP); }
uint drawn_row() { return uint(gl_VertexID) / 4u % GROUP; }
