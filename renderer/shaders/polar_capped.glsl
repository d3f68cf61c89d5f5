// The map of a laser station, as pipeline/cameras/polar_capped.py has it: bottom cap, top cap, band side by side, `height` rows.
// CEIG 2019, equations 4 to 6, in the form that is their inverse.
//
// Arcs are computed here: what drivers give for atan may be off by 4,096 units in the last place, half a texel of a large map; this is
// within 3 (Cephes' single-precision polynomial, after halving the range at tan(pi/8)).

const uint BOTTOM = 0u, TOP = 1u, BAND = 2u;
const float PI = 3.14159265358979;

float arc(float y, float x) {
    float ax = abs(x), ay = abs(y), high = max(ax, ay);
    float z = high > 0.0 ? min(ax, ay) / high : 0.0, whole = 0.0;
    if (z > 0.414213562) {
        z = (z - 1.0) / (z + 1.0);
        whole = PI / 4.0;
    }
    float s = z * z;
    float found = whole + (((8.05374449538e-2 * s - 1.38776856032e-1) * s + 1.99777106478e-1) * s - 3.33329491539e-1) * s * z + z;
    if (ay > ax) found = PI / 2.0 - found;
    if (x < 0.0) found = PI - found;
    return y < 0.0 ? -found : found;
}

uint chart_of(vec3 d) {
    return abs(d.z) <= length(d.xy) ? BAND : d.z > 0.0 ? TOP : BOTTOM;
}

// Column and row of a direction of any length but 0.
vec2 project(vec3 d, float height) {
    uint chart = chart_of(d);
    float rho = length(d.xy);
    if (chart == BAND) {
        float turn = arc(d.y, d.x) / (2.0 * PI);
        return height * vec2(4.0 * (turn - floor(turn)) + 2.0, arc(d.z, rho) * (2.0 / PI) + 0.5);
    }
    float stretch = rho > 0.0 ? arc(rho, abs(d.z)) * (2.0 / PI) / rho : 0.0;
    return height * (d.xy * stretch + vec2(float(chart) + 0.5, 0.5));
}

// The unit direction at a column and row.
vec3 unproject(vec2 at, float height) {
    vec2 st = at / height;
    if (st.x >= 2.0) {
        vec2 angle = (st - vec2(2.0, 0.5)) * (PI / 2.0);
        return vec3(cos(angle.y) * vec2(cos(angle.x), sin(angle.x)), sin(angle.y));
    }
    bool is_top = st.x >= 1.0;
    vec2 uv = st - vec2(is_top ? 1.5 : 0.5, 0.5);
    float r = length(uv), down = cos(PI / 2.0 * r);
    return vec3(uv * (r > 0.0 ? sin(PI / 2.0 * r) / r : PI / 2.0), is_top ? down : -down);
}
