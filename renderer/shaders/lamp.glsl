// What a lamp makes of the light that photographs recorded, see renderer/effects/relighting.py.

uniform vec3 towards_light;
uniform float ambient, diffuse;

vec3 under_lamp(vec3 linear, vec3 normal) {
    float facing = dot(normal, towards_light) / max(length(normal), 1e-6);
    return linear * (ambient + diffuse * max(0.0, facing));
}
