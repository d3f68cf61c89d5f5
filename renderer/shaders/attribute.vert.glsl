// Pass 3: weighted colours of all splats within the margin; one variant for each atom count.

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
#include "srgb.glsl"
#if defined(N_ATOMS) || defined(CLIPLINE) || defined(ELLIPSOID)
#include "bits.glsl"
#include "groups.glsl"
#endif
#ifdef CLIPLINE
#include "clipline.glsl"
#endif
#ifdef N_ATOMS
#include "splat_codes.glsl"
#endif

// Texels of a square one radius wide, halved: half a level finer than a texel a pixel, as patches are smooth already.
// Measured against the photo baseline on fountain_p11 (37,000 splats, patches not compressed) at the photo's size, a
// half and a quarter of it: 46.8, 43.6, 38.2 dB as it is, 49.7, 45.4, 38.7 half finer, 51.7, 44.4, 36.9 a whole one.
const float ATOM_AREA = 0.5 * 16.0 * 16.0;

// From which part of a level on the coarser one is taken, where levels are not blended: 1 - 0.45. On the stereo pair of `make demo`
// 0.5, 0.35 and 0.2 here come to 29.2, 29.5 and 29.7 dB to the photographs at 1,024 px, blended levels to 29.3; on monstree to 24.2, 24.1
// and 24.1.
const float TO_COARSER = 0.45;

#include "lit.vert.glsl"
#ifdef PAGES
#include "pages.vert.glsl"
#endif
out vec4 place;
#ifdef DETAIL
flat out float share;
#endif

flat out vec3 average;  // in linear light where there are neither atoms nor maps, else sRGB

void main() {
    uint group = drawn_group(), row = drawn_row();
    uint splat = splat_of_row(group, row);
    if (!is_drawn(splat)) {
        gl_Position = vec4(2.0, 2.0, 2.0, 1.0);  // outside the picture
        return;
    }
#ifdef ELLIPSOID
    Ellipsoid ellipsoid = decode_ellipsoid(splat, ellipsoids[first_ellipsoid(group) + row]);
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
#ifdef DETAIL
    share = share_of(group);
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
    SET_NORMAL(disc)
    gl_Position = quad.clip;
    place = quad.place;
#ifdef PAGES
#ifdef ELLIPSOID
    find_pages(splat, Disc(ellipsoid.centre, ellipsoid.a, ellipsoid.b, ellipsoid.radius), ellipsoid.c, quad.area_px);
#else
    find_pages(splat, disc, quad.area_px);
#endif
#endif
#ifdef N_ATOMS
    average = decode_color(splat);
#ifdef LEVELS
    level = clamp(mip_level(ATOM_AREA, quad.area_px), float(scene.finest_level), float(scene.coarsest_level));
#ifndef BLENDED
    level = floor(level + TO_COARSER);
#endif
#endif
    read_atoms(group, row);
#elif defined(MAPPED)
    average = decode_color(splat);
#else
    average = to_linear(decode_color(splat));
#endif
#ifdef CLIPLINE
    clipline = read_clipline(group, row);
#endif
}
