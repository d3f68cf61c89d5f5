// Pass 2: depth of the nearest surface, pushed back by the margin within which splats blend.

#define PUSHED 1
#include "view.glsl"
#include "find_splat.glsl"
#include "splat_geometry.glsl"
#include "splat_quad.glsl"
#ifdef CLIPLINE
#include "bits.glsl"
#include "groups.glsl"
#include "clipline.glsl"
#endif

out vec4 place;

void main() {
    Quad quad = splat_quad(decode_disc(splat_of_row(drawn_group(), drawn_row())));
    gl_Position = quad.clip;
    place = quad.place;
#ifdef CLIPLINE
    clipline = read_clipline(drawn_group(), drawn_row());
#endif
}
