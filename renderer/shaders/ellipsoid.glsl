// An ellipsoid, drawn as the disc whose image is the ellipsoid's outline, with the depth of its surface put in by fragments.
//
// Paper: 2020, section 3.2, after Sigg et al. 2006. Where the ellipsoid is the unit ball, the eye lies at `eye_distance` along
// `z`; every disc across z whose rim touches the cone of the ball's outline has that outline. The disc here lies where the
// eye's side of the ball is nearest, so its depth is a bound, and it is sized so that the outline is exactly its unit circle.
// With D the eye's distance and the point (x, y) of that circle, k = sqrt(1 - x^2 - y^2), the ray through it meets the ball at
// (x sqrt(D^2 - 1), y sqrt(D^2 - 1), 1 + D k) / (D + k), (D + 1) / (D + k) times as far as it meets the disc: no digit
// is lost however far the eye is. Needs view.glsl and splat_geometry.glsl.

layout(std430, binding = 9) readonly buffer Ellipsoids { uint ellipsoids[]; };  // turn and three lengths, 8 bits each

struct Ellipsoid {
    vec3 centre;   // in camera axes, against the eye
    vec3 a, b, c;  // half axes
    float radius;  // that of the splat
};

flat out float eye_distance;  // 0 where the eye is inside
flat out mat3 facing;         // axes x, y, z of the disc in those of the ball

Ellipsoid decode_ellipsoid(uint splat, uint word) {
    ivec3 normal;
    uint cell = read_splat(splat, normal);
    vec3 u, v;
    decode_frame(normal, u, v);
    float turn = float(word & 255u) * (3.14159265358979 / 256.0);
    float radius = radius_of(splat);
    vec3 lengths = radius * exp2((vec3((uvec3(word) >> uvec3(8u, 16u, 24u)) & 255u) - 191.0) / 32.0);
    return Ellipsoid(world_to_camera(decode_position(splat, cell)),
                     lengths.x * world_to_camera(cos(turn) * u + sin(turn) * v),
                     lengths.y * world_to_camera(cos(turn) * v - sin(turn) * u),
                     lengths.z * world_to_camera(cross(u, v)), radius);
}

Disc outline_of(Ellipsoid e) {
    vec3 eye = -vec3(dot(e.centre, e.a) / dot(e.a, e.a), dot(e.centre, e.b) / dot(e.b, e.b), dot(e.centre, e.c) / dot(e.c, e.c));
    eye_distance = length(eye);
    if (eye_distance <= 1.0) {
        eye_distance = 0.0;
        return Disc(vec3(0.0), vec3(0.0), vec3(0.0), e.radius);
    }
    vec3 z = eye / eye_distance;
    vec3 x = normalize(abs(z.x) < 0.7 ? vec3(0.0, z.z, -z.y) : vec3(-z.z, 0.0, z.x));
    facing = mat3(x, cross(z, x), z);
    mat3 axes = mat3(e.a, e.b, e.c);
    float rim = sqrt((eye_distance - 1.0) / (eye_distance + 1.0));
    return Disc(e.centre + axes * z, rim * (axes * facing[0]), rim * (axes * facing[1]), e.radius);
}
