// The normal of a splat for relighting, in camera axes and turned to the eye. Needs splat_geometry.glsl.

#if defined(LIT) || defined(SMOOTH)
flat out vec3 normal;

vec3 normal_of(Disc disc) {
    vec3 across = cross(disc.u, disc.v);
    across /= max(length(across), 1e-30);
    return dot(across, disc.centre) > 0.0 ? -across : across;
}
#define SET_NORMAL(disc) normal = normal_of(disc);
#else
#define SET_NORMAL(disc)
#endif
