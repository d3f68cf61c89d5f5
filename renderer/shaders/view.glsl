// The view and the scene, as renderer/splats/projection.py and renderer/splats/scene.py write them, field for field.
// Camera axes: x right, y down, z forward; row 0 of the framebuffer is the top row of the picture.

layout(std140, binding = 0) uniform View {
    vec4 camera_x, camera_y, camera_z;  // rows of the rotation from world to camera
    vec4 eye_high, eye_low;             // the eye against the scene's origin, as the sum of two floats
    vec4 lens;                          // fx, fy, cx, cy in px
    vec4 screen;                        // width and height in px, near plane in the scene's unit, depth margin in radii
} view;

layout(std140, binding = 1) uniform Scene {
    ivec4 up, ahead;  // what tangent frames are aligned with
    float radius;
    uint n_splats;
    uint n_batches;
    uint dictionary_bits;
    uint weight_bits;
    uint n_groups;
    uint atlas_width;
    uint finest_level;  // of the atoms: 0 where they have 32 texels to a side, 1 for 16, 2 for 8
    uvec4 atlas_bands;  // first row of the mip levels 0 to 3
    uvec2 atlas_bands_beyond;  // of the levels 4 and 5
    vec2 atlas_texel;  // one texel in texture coordinates
    uint coarsest_level;  // of the atoms: 5 where they have a level of one texel
    uint n_ranks;  // rows of weight levels
} scene;

const uint CHUNK = 128u;
const uint CHUNKS_PER_GROUP = 64u;
const uint GROUP = CHUNK * CHUNKS_PER_GROUP;

// Differences to a nearby place, as the eye, are taken part by part, so that large coordinates do not jitter.
vec3 against(vec3 place_high, vec3 place_low, vec3 point) {
    precise vec3 near_place = point - place_high;
    precise vec3 result = near_place - place_low;
    return result;
}

vec3 against_eye(vec3 point) { return against(view.eye_high.xyz, view.eye_low.xyz, point); }

vec3 world_to_camera(vec3 v) {
    return vec3(dot(view.camera_x.xyz, v), dot(view.camera_y.xyz, v), dot(view.camera_z.xyz, v));
}
