// Where a splat lies in its photograph: what pages.frag.glsl looks its pages up by. As baseline.vert.glsl has it.

struct Photo { mat4 to_px; uvec4 grids; };  // from camera axes of the view; row of the finest level, levels, width and height
layout(std430, binding = 15) readonly buffer Photos { Photo photos[]; };
layout(std430, binding = 16) readonly buffer SplatPhotos { uint splat_photos[]; };  // two 16-bit numbers a word

const uint NO_PHOTO = 0xFFFFu;
flat out vec3 page_centre, page_u, page_v;
#ifdef ELLIPSOID
flat out vec3 page_w;
#endif
flat out float page_level;
flat out uvec4 page_grids;  // without levels where the splat has no photograph

#ifdef ELLIPSOID
void find_pages(uint splat, Disc square, vec3 third, float area_px) {
#else
void find_pages(uint splat, Disc square, float area_px) {
#endif
    uint photo = splat_photos[splat >> 1] >> (16u * (splat & 1u)) & 0xFFFFu;
    page_centre = page_u = page_v = vec3(0.0);
    page_level = 0.0;
    page_grids = uvec4(0u);
#ifdef ELLIPSOID
    page_w = vec3(0.0);
#endif
    if (photo == NO_PHOTO) return;
    mat4 to_px = photos[photo].to_px;
    page_centre = (to_px * vec4(square.centre, 1.0)).xyz;
    page_u = mat3(to_px) * square.u;
    page_v = mat3(to_px) * square.v;
#ifdef ELLIPSOID
    page_w = mat3(to_px) * third;
#endif
    if (page_centre.z <= 0.0) return;
    vec2 seen = page_centre.xy / page_centre.z;
    mat2 image = mat2(page_u.xy - seen * page_u.z, page_v.xy - seen * page_v.z) / page_centre.z;
    page_level = mip_level(abs(determinant(image)), area_px);
    page_grids = photos[photo].grids;
}
