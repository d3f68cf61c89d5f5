// The triangle that a splat is drawn as, and the low-pass filter of splats smaller than a pixel.
//
// One triangle around the disc, not the two of a square: most splats are a few pixels wide, and what they cost is their set-up. On
// fountain_p11 at 1,024 px (llvmpipe, processor seconds of whole frames) 31 % less without effects, 27 % less with those it calls for.
//
// A fragment belongs to a splat where d < 1, d the smaller of two distances: on the disc, in radii, and on the screen,
// in px from the projected centre (after Botsch et al., "High-quality surface splatting on today's GPUs", PBG 2005). So
// every splat covers a pixel, however small or oblique.
// Where the disc's image is at least a pixel to all sides the first distance is the smaller one everywhere, and the
// triangle stands around the disc. Else the disc is drawn by its affine image at the depth of its centre.
// Needs view.glsl and splat_geometry.glsl.

const float LOW_PASS_PX = 1.0;
const float SMALLEST_PX = 1e-3;   // of a half axis; thinner images are drawn as if so wide
const float ROUNDING = 1e-5;      // of the distance: so much further back, or a splat might hide itself
const vec2 FAR_FROM_CENTRE = vec2(1e3);

const vec2 CORNERS[3] = vec2[](vec2(-1.7320508, -1.0), vec2(1.7320508, -1.0), vec2(0.0, 2.0));  // around the unit circle

vec2 drawn_corner() { return CORNERS[gl_VertexID & 3]; }

#ifdef ELLIPSOID
float reach_of(Disc disc) { return sqrt(dot(disc.u, disc.u) + dot(disc.v, disc.v)); }
#else
float reach_of(Disc disc) { return disc.radius; }
#endif

struct Quad {
    vec4 clip;       // gl_Position of this corner
    vec4 place;      // x, y on the disc in radii; x, y on the screen in px from the projected centre
    float area_px;   // of the image of the square between the tangents; negative where it is not known
};

// Derivatives of screen px by x and y on the disc, at its centre: columns are the images of u and v.
mat2 image_of_disc(Disc disc) {
    vec2 slope = disc.centre.xy / disc.centre.z;
    return mat2(view.lens.xy * (disc.u.xy - slope * disc.u.z) / disc.centre.z,
                view.lens.xy * (disc.v.xy - slope * disc.v.z) / disc.centre.z);
}

// Clip coordinates of a point of the disc, in camera axes. w = z, and depth is near / z: 1 near, 0 far.
// With PUSHED the depth is that of the disc scaled away from the eye until its centre has moved by the margin, so many radii: that
// leaves it flat, so that depths between corners are right too, and moves nothing on the screen. A splat below a pixel is drawn as wide as one, so
// its margin is of that width: else only the nearest of the many splats on a pixel of a far or slanted surface would colour it.
vec4 to_clip(Disc disc, vec3 point) {
    vec2 slope = 2.0 * view.lens.xy / view.screen.xy;
    vec2 shift = 2.0 * view.lens.zw / view.screen.xy - 1.0;
    float near = view.screen.z;
#ifdef PUSHED
    float distance = length(disc.centre);
    float drawn = max(disc.radius, LOW_PASS_PX * disc.centre.z / min(view.lens.x, view.lens.y));
    near *= distance / max(distance + view.screen.w * drawn + ROUNDING * distance, 1e-30);
#endif
    return vec4(slope * point.xy + shift * point.z, near, point.z);
}

Quad affine_quad(Disc disc, mat2 image, vec2 corner, float area_px) {
    float xx = image[0].x * image[0].x + image[1].x * image[1].x;
    float yy = image[0].y * image[0].y + image[1].y * image[1].y;
    float xy = image[0].x * image[0].y + image[1].x * image[1].y;
    float spread = length(vec2(0.5 * (xx - yy), xy));
    float major_px = sqrt(0.5 * (xx + yy) + spread);
    float minor_px = area_px / max(major_px, 1e-30);
    vec2 along = xx > yy ? vec2(0.5 * (xx - yy) + spread, xy) : vec2(xy, 0.5 * (yy - xx) + spread);
    along = spread > 0.0 ? normalize(along) : vec2(1.0, 0.0);
    vec2 across = vec2(-along.y, along.x);
    vec2 on_disc = along * image;  // of length major_px
    on_disc = major_px > 1e-12 ? on_disc / major_px : vec2(1.0, 0.0);
    vec2 on_disc_across = vec2(-on_disc.y, on_disc.x) * (determinant(image) < 0.0 ? -1.0 : 1.0);

    vec2 offset_px = corner * vec2(max(major_px, LOW_PASS_PX), LOW_PASS_PX);
    vec2 in_radii = offset_px / max(vec2(major_px, minor_px), SMALLEST_PX);
    vec2 screen_px = along * offset_px.x + across * offset_px.y;
    vec4 clip = to_clip(disc, disc.centre);
    clip.xy += 2.0 * screen_px / view.screen.xy * clip.w;
    return Quad(clip, vec4(on_disc * in_radii.x + on_disc_across * in_radii.y, screen_px / LOW_PASS_PX), area_px);
}

Quad splat_quad(Disc disc) {
#ifdef ELLIPSOID
    if (eye_distance == 0.0) return Quad(vec4(2.0, 2.0, 2.0, 1.0), vec4(2.0), -1.0);  // outside the picture
#endif
    vec2 corner = drawn_corner();
    float area_px = -1.0;
    if (disc.centre.z > 2.0 * reach_of(disc)) {
        mat2 image = image_of_disc(disc);
        area_px = abs(determinant(image));
        // Of two squares of half axes, with sum s and product p, the smaller is below l where (l - s) l + p < 0, or
        // where both are.
        float sum = dot(image[0], image[0]) + dot(image[1], image[1]);
        float limit = LOW_PASS_PX * LOW_PASS_PX;
        if (sum - limit > area_px * area_px / limit || sum < 2.0 * limit)
            return affine_quad(disc, image, corner, area_px);
    }
    vec3 point = disc.centre + corner.x * disc.u + corner.y * disc.v;
    return Quad(to_clip(disc, point), vec4(corner, FAR_FROM_CENTRE), area_px);
}

// The mip level at which one texel covers one pixel, for a texture of which the square between the tangents covers
// `area_texels`; at most the level at which the whole splat, four such squares, is one texel.
float mip_level(float area_texels, float area_px) {
    return area_px < 0.0 ? 0.0 : max(0.0, 0.5 * log2(area_texels / max(area_px, 0.25)));
}
