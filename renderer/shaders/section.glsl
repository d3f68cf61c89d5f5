// A box in the scan's axes, against the eye: splats whose middle lies outside are not drawn. Needs splat_geometry.glsl.

#ifdef SECTION
uniform vec3 section_low, section_high;

bool is_cut(Disc disc) {
    vec3 at = disc.centre.x * view.camera_x.xyz + disc.centre.y * view.camera_y.xyz + disc.centre.z * view.camera_z.xyz;
    return any(lessThan(at, section_low)) || any(greaterThan(at, section_high));
}
#else
#define is_cut(disc) false
#endif
