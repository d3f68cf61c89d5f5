// Pass 2: depth of the nearest surface, pushed back by the margin within which splats blend.

#define PUSHED 1
#include "view.glsl"
#include "find_splat.glsl"
#include "detail.glsl"
#include "splat_geometry.glsl"
#include "section.glsl"
#ifdef ELLIPSOID
#include "ellipsoid.glsl"
#endif
#include "splat_quad.glsl"
#ifdef MAPPED
#include "polar_capped.glsl"
#include "map_of_splat.glsl"
#endif
#ifdef UNMAPPED
#include "unmapped.glsl"
#endif
#if defined(CLIPLINE) || defined(ELLIPSOID)
#include "bits.glsl"
#include "groups.glsl"
#endif
#ifdef CLIPLINE
#include "clipline.glsl"
#endif

out vec4 place;

void main() {
    uint splat = splat_of_row(drawn_group(), drawn_row());
    if (!is_drawn(splat) || share_of(drawn_group()) < HIDES_FROM) {
        gl_Position = vec4(2.0, 2.0, 2.0, 1.0);  // outside the picture
        return;
    }
#ifdef ELLIPSOID
    Ellipsoid ellipsoid = decode_ellipsoid(splat, ellipsoids[first_ellipsoid(drawn_group()) + drawn_row()]);
    Disc disc = outline_of(ellipsoid);
#ifdef MAPPED
    set_map(splat, ellipsoid.a, ellipsoid.b, ellipsoid.centre);
    map_w = camera_to_world(ellipsoid.c);
#endif
#else
    Disc disc = decode_disc(splat);
#ifdef FRONT
#include "front.vert.glsl"
#endif
#ifdef MAPPED
    set_map(splat, disc.u, disc.v, disc.centre);
#endif
#endif
#ifdef UNMAPPED
#include "unmapped.vert.glsl"
#endif
    if (is_cut(disc)) {
        gl_Position = vec4(2.0, 2.0, 2.0, 1.0);
        return;
    }
    Quad quad = splat_quad(disc);
#ifdef MAPPED
    set_map_level(quad.area_px);
    if (is_of_other_program()) {
        gl_Position = vec4(2.0, 2.0, 2.0, 1.0);
        return;
    }
#endif
    gl_Position = quad.clip;
    place = quad.place;
#ifdef CLIPLINE
    clipline = read_clipline(drawn_group(), drawn_row());
#endif
}
