// The weighted sum of a splat's atoms at a place on its square. Needs view.glsl.
//
// Atoms lie side by side in one texture, so coordinates stop half a texel before an atom's edge, at each level on its
// own. All fragments of a splat share one level, so the branch below is the same for all of them.

layout(binding = 0) uniform sampler2D atlas;
#ifdef LEVELS
flat in float level;  // a whole one, but where BLENDED
#endif
#ifdef BLENDED
flat in uvec3 atoms[N_ATOMS];  // weight, corner, corner of the coarser level: see splat_codes.glsl
#else
flat in uvec2 atoms[N_ATOMS];
#endif
#ifdef TURNED
flat in uvec2 turns;  // 3 bits a rank, 8 ranks in each

// Where an atom is looked up: bit 2 mirrors at the diagonal, then bit 0 from left to right, bit 1 from top to bottom.
vec2 turned(vec2 on_disc, int rank) {
    uint turn = turns[rank >> 3] >> (3 * (rank & 7));
    vec2 at = (turn & 4u) != 0u ? on_disc.yx : on_disc;
    return vec2((turn & 1u) != 0u ? -at.x : at.x, (turn & 2u) != 0u ? -at.y : at.y);
}
#else
#define turned(on_disc, rank) on_disc
#endif

vec3 atlas_color(vec2 texel) { return textureLod(atlas, texel * scene.atlas_texel, 0.0).rgb; }

vec2 corner_of(uint packed_corner) { return vec2(packed_corner & 0xFFFFu, packed_corner >> 16); }

vec2 inside_atom(vec2 on_disc, float size) {
    return clamp((on_disc + 1.0) * 0.5 * size, 0.5, size - 0.5);
}

vec3 sum_of_atoms(vec2 on_disc) {
#ifdef LEVELS
    float finer = floor(level);
#else
    float finer = float(scene.finest_level);
#endif
    float size = exp2(5.0 - finer);
    vec3 sum = vec3(0.0);
    for (int rank = 0; rank < N_ATOMS; ++rank)
        sum += uintBitsToFloat(atoms[rank].x) * atlas_color(corner_of(atoms[rank].y) + inside_atom(turned(on_disc, rank), size));
#ifdef BLENDED
    float blend = level - finer;
    if (blend > 0.0) {
        vec3 coarser_sum = vec3(0.0);
        for (int rank = 0; rank < N_ATOMS; ++rank)
            coarser_sum += uintBitsToFloat(atoms[rank].x)
                * atlas_color(corner_of(atoms[rank].z) + inside_atom(turned(on_disc, rank), 0.5 * size));
        sum = mix(sum, coarser_sum, blend);
    }
#endif
    return sum;
}
