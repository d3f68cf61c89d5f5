// The atoms of a splat and their weights, read from the code stream of storage/packed/codes.py. Needs bits.glsl, groups.glsl.

layout(std430, binding = 4) readonly buffer Codes { uint codes[]; };
layout(std430, binding = 6) readonly buffer Weights { float weights[]; };  // weight_levels (n_ranks, levels), then atom_scale

uniform uint atoms_stored;  // of each code of this batch; N_ATOMS of them are drawn: FEWER are those with the largest weights
// Of each atom the weight of a texel of 1.0, its corner in the atlas at its level (of two the finer), and at the one after that: 16
// atoms are 16 of the 31 vectors that common drivers pass on.
#ifdef BLENDED
flat out uvec3 atoms[N_ATOMS];
#else
flat out uvec2 atoms[N_ATOMS];
#endif
#ifdef LEVELS
flat out float level;
#endif
#ifdef TURNED
flat out uvec2 turns;  // 3 bits a rank, 8 ranks in each
#endif

// Where an atom's texels begin, row above column in 16 bits each; see corner() of renderer/splats/atlas.py.
uint atom_corner(uint atom, uint at_level) {
    uint size = 32u >> at_level;
    uint columns = scene.atlas_width / size;
    uint band = at_level < 4u ? scene.atlas_bands[at_level] : scene.atlas_bands_beyond[at_level - 4u];
    return atom % columns * size | (band + atom / columns * size) << 16;
}

void read_atoms(uint group, uint row) {
#ifdef LEVELS
    uint finer = uint(level);
#else
    uint finer = scene.finest_level;
#endif
    uint n_levels = 1u << scene.weight_bits;
    uint entry_bits = scene.dictionary_bits + scene.weight_bits;
    uint first_bit = (first_entry(group) + row * atoms_stored) * entry_bits;
    uint word = code_word(group);
#ifdef TURNED
    turns = uvec2(0u);
#endif
#ifdef FEWER
    float held[N_ATOMS];  // the sizes of the weights that are drawn
    for (uint place = 0u; place < uint(N_ATOMS); ++place) held[place] = -1.0;
    for (uint rank = 0u; rank < atoms_stored; ++rank, first_bit += entry_bits) {
#else
    for (uint rank = 0u; rank < uint(N_ATOMS); ++rank, first_bit += entry_bits) {
#endif
        uint entry = READ_BITS(codes, word, first_bit, entry_bits);
        uint atom = entry & ((1u << scene.dictionary_bits) - 1u);
        float weight = weights[rank * n_levels + (entry >> scene.dictionary_bits)];
#ifdef FEWER
        uint at = 0u;
        for (uint place = 1u; place < uint(N_ATOMS); ++place)
            if (held[place] < held[at]) at = place;
        if (abs(weight) <= held[at]) continue;
        held[at] = abs(weight);
#else
        uint at = rank;
#endif
#ifdef TURNED
        turns[at >> 3] = turns[at >> 3] & ~(7u << (3u * (at & 7u))) | (atom & 7u) << (3u * (at & 7u));
        atom >>= 3u;
#endif
        weight *= weights[scene.n_ranks * n_levels + atom];
        atoms[at].xy = uvec2(floatBitsToUint(127.0 * weight), atom_corner(atom, finer));
#ifdef BLENDED
        atoms[at].z = atom_corner(atom, min(finer + 1u, scene.coarsest_level));
#endif
    }
}
