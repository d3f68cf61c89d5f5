// Depth and place of a fragment on an ellipsoid, see ellipsoid.glsl. Needs `place`.

flat in float eye_distance;
flat in mat3 facing;

void set_depth(float d2) {
    gl_FragDepth = gl_FragCoord.z * (eye_distance + sqrt(1.0 - d2)) / (eye_distance + 1.0);
}

// In the axes of the unit ball; its normal there too.
vec3 on_ball() {
    float d2 = dot(place.xy, place.xy);
    vec2 on_circle = d2 > 1.0 ? place.xy * inversesqrt(d2) : place.xy;
    float k = sqrt(max(0.0, 1.0 - d2));
    vec3 seen = vec3(on_circle * sqrt(eye_distance * eye_distance - 1.0), 1.0 + eye_distance * k);
    return facing * seen / (eye_distance + k);
}
