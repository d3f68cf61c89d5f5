// The atoms of a splat and their weights, read from the code stream of storage/codes.py. Needs bits.glsl, groups.glsl.

layout(std430, binding = 4) readonly buffer Codes { uint codes[]; };
layout(std430, binding = 6) readonly buffer Weights { float weights[]; };  // weight_levels (8, levels), then atom_scale

uniform uint atoms_stored;  // of each code of this batch; N_ATOMS of them are drawn
flat out vec3 atoms[N_ATOMS];    // corner of each atom's finer level in the atlas, and weight of a texel of 1.0
#ifdef LEVELS
flat out vec2 coarser[N_ATOMS];  // corner of the level after that
flat out float level;
#endif
#ifdef TURNED
flat out uint turns;  // 3 bits a rank
#endif

// Where an atom's texels begin; see corner() of renderer/atlas.py.
vec2 atom_corner(uint atom, uint at_level) {
    uint size = 32u >> at_level;
    uint columns = scene.atlas_width / size;
    uint band = at_level < 4u ? scene.atlas_bands[at_level] : scene.atlas_bands_beyond[at_level - 4u];
    return vec2(atom % columns * size, band + atom / columns * size);
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
    turns = 0u;
#endif
    for (uint rank = 0u; rank < uint(N_ATOMS); ++rank, first_bit += entry_bits) {
        uint entry = READ_BITS(codes, word, first_bit, entry_bits);
        uint atom = entry & ((1u << scene.dictionary_bits) - 1u);
#ifdef TURNED
        turns |= (atom & 7u) << (3u * rank);
        atom >>= 3u;
#endif
        float weight = weights[rank * n_levels + (entry >> scene.dictionary_bits)] * weights[8u * n_levels + atom];
        atoms[rank] = vec3(atom_corner(atom, finer), 127.0 * weight);
#ifdef LEVELS
        coarser[rank] = atom_corner(atom, min(finer + 1u, scene.coarsest_level));
#endif
    }
}
