// Running counts of batches inside a group; derived at load from batch_count, see running_counts() of scene.py.
// Needs view.glsl.

#ifndef RUNNING_COUNTS
#define RUNNING_COUNTS
layout(std430, binding = 2) readonly buffer RunningCounts { uint running_counts[]; };  // uint16, two a word

// How many splats of the chunk's group stand in chunks up to this one and in batches below `batch`.
uint counted(uint chunk, uint batch) {
    if (batch == 0u) return 0u;
    if (batch == scene.n_batches)
        return min((chunk + 1u) * CHUNK, scene.n_splats) - chunk / CHUNKS_PER_GROUP * GROUP;
    uint at = chunk * (scene.n_batches - 1u) + batch - 1u;
    return (running_counts[at >> 1] >> ((at & 1u) * 16u)) & 0xFFFFu;
}

uint counted_of(uint chunk, uint batch) {
    return counted(chunk, batch + 1u) - counted(chunk, batch);
}

uint last_chunk(uint group) {
    return min((group + 1u) * CHUNKS_PER_GROUP, (scene.n_splats + CHUNK - 1u) / CHUNK) - 1u;
}
#endif
