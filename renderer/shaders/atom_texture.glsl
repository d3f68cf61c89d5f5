// The weighted sum of a splat's atoms at a place on its square. Needs view.glsl.
//
// Atoms lie side by side in one texture, so coordinates stop half a texel before an atom's edge, at each level on its
// own. All fragments of a splat share one level, so the branch below is the same for all of them.

layout(binding = 0) uniform sampler2D atlas;
flat in vec3 atoms[N_ATOMS];
flat in vec2 coarser[N_ATOMS];
flat in float level;

vec3 atlas_color(vec2 texel) { return textureLod(atlas, texel * scene.atlas_texel, 0.0).rgb; }

vec2 inside_atom(vec2 on_disc, float size) {
    return clamp((on_disc + 1.0) * 0.5 * size, 0.5, size - 0.5);
}

vec3 sum_of_atoms(vec2 on_disc) {
    float finer = floor(level), blend = level - finer;
    float size = exp2(5.0 - finer);
    vec2 inside = inside_atom(on_disc, size);
    vec3 sum = vec3(0.0);
    for (int rank = 0; rank < N_ATOMS; ++rank)
        sum += atoms[rank].z * atlas_color(atoms[rank].xy + inside);
    if (blend > 0.0) {
        vec3 coarser_sum = vec3(0.0);
        inside = inside_atom(on_disc, 0.5 * size);
        for (int rank = 0; rank < N_ATOMS; ++rank)
            coarser_sum += atoms[rank].z * atlas_color(coarser[rank] + inside);
        sum = mix(sum, coarser_sum, blend);
    }
    return sum;
}
