// Whether a splat is looked up in the map of a laser station. Needs view.glsl, splat_geometry.glsl.

layout(std430, binding = 12) readonly buffer SplatMaps { uint splat_maps[]; };  // a byte a splat: its map, 255 none

const float LOOKED_UP_FROM_PX = 2.5;  // of a splat's radius on the screen; a smaller one is its mean colour

// `z`: how far before the camera it lies.
bool is_looked_up(uint splat, float z, out uint map) {
    map = splat_maps[splat >> 2] >> (8u * (splat & 3u)) & 0xFFu;
    return map != 255u && !(z > 0.0 && radius_of(splat) * max(view.lens.x, view.lens.y) < LOOKED_UP_FROM_PX * z);
}
