// The attribute pass of the baseline: splats of one photo, named by a list, textured from the photo itself.

#include "view.glsl"
#include "splat_geometry.glsl"
#ifdef ELLIPSOID
#include "ellipsoid.glsl"
#endif
#include "splat_quad.glsl"

layout(std430, binding = 4) readonly buffer Listed { uint listed[]; };  // splats, camera by camera
uniform uint first_listed;
#ifdef CLIPLINE
#include "decode_clipline.glsl"
layout(std430, binding = 5) readonly buffer Lines { uint lines[]; };  // a clipline code for each listed splat
flat out vec3 clipline;
#endif

#include "lit.vert.glsl"
out vec4 place;
flat out vec3 average;
#ifdef PHOTO
uniform mat4 photo;  // from camera axes of the view to homogeneous px of the photo
flat out vec3 photo_centre, photo_u, photo_v;
#ifdef ELLIPSOID
flat out vec3 photo_w;
#endif
flat out float level;
#endif

void main() {
    uint at = first_listed + uint(gl_VertexID) / 4u;
    uint splat = listed[at];
#ifdef ELLIPSOID
    Ellipsoid ellipsoid = decode_ellipsoid(splat, ellipsoids[at]);
    Disc square = Disc(ellipsoid.centre, ellipsoid.a, ellipsoid.b, ellipsoid.radius);
    Disc disc = outline_of(ellipsoid);
#else
    Disc disc = decode_disc(splat), square = disc;
#endif
    Quad quad = splat_quad(disc);
    SET_NORMAL(disc)
    gl_Position = quad.clip;
    place = quad.place;
    average = decode_color(splat);
#ifdef PHOTO
    photo_centre = (photo * vec4(square.centre, 1.0)).xyz;
    photo_u = mat3(photo) * square.u;
    photo_v = mat3(photo) * square.v;
#ifdef ELLIPSOID
    photo_w = mat3(photo) * ellipsoid.c;
#endif
    vec2 seen = photo_centre.xy / photo_centre.z;
    mat2 image = mat2(photo_u.xy - seen * photo_u.z, photo_v.xy - seen * photo_v.z) / photo_centre.z;
    level = photo_centre.z > 0.0 ? mip_level(abs(determinant(image)), quad.area_px) : 0.0;
#endif
#ifdef CLIPLINE
    clipline = decode_clipline(lines[at]);
#endif
}
