// Pass 1: one invocation a group writes its draws, one a batch and one for all batches; empty where its box lies
// outside the view, or where other levels are drawn instead.

layout(local_size_x = 64) in;

#include "view.glsl"
#include "running_counts.glsl"
#include "detail.glsl"

struct Draw { uint n_indices, n_instances, first_index, base_vertex, base_instance; };
layout(std430, binding = 7) readonly buffer GroupBoxes { float group_boxes[]; };  // low, high; grown by the radius; with FRONT axis and cosine of a cone
layout(std430, binding = 8) writeonly buffer Draws { Draw draws[]; };             // batch by batch, then whole groups; then the same of groups looked up
#ifdef LOOKED_UP
layout(std430, binding = 18) readonly buffer LookedUp { uint looked_up[]; };      // of each group, 1 where any splat of it may be, see upload/maps.py
#endif

const float SPARE_PX = 1.0;  // what the low-pass filter reaches beyond a disc

bool reaches_inside(vec3 low, vec3 high, vec3 plane) {
    vec3 inward = plane.x * view.camera_x.xyz + plane.y * view.camera_y.xyz + plane.z * view.camera_z.xyz;
    return dot(inward, mix(low, high, greaterThan(inward, vec3(0.0)))) >= 0.0;
}

bool in_view(vec3 low, vec3 high) {
    float fx = view.lens.x, fy = view.lens.y;
    vec2 before = view.lens.zw + SPARE_PX, behind = view.screen.xy - view.lens.zw + SPARE_PX;
    return reaches_inside(low, high, vec3(0.0, 0.0, 1.0))
        && reaches_inside(low, high, vec3(fx, 0.0, before.x)) && reaches_inside(low, high, vec3(-fx, 0.0, behind.x))
        && reaches_inside(low, high, vec3(0.0, fy, before.y)) && reaches_inside(low, high, vec3(0.0, -fy, behind.y));
}

#ifdef FRONT
const uint BOX = 10u;

// Whether all of a group shows its back: directions to the ball about its box lie within `b` of one another's middle, normals within the cone's
// half angle `c` of its axis, and these are less than 90 degrees - b - c apart.
bool all_back(uint at, vec3 low, vec3 high) {
    vec3 axis = vec3(group_boxes[at + 6u], group_boxes[at + 7u], group_boxes[at + 8u]), middle = 0.5 * (low + high);
    float away = length(middle), sin_b = 0.5 * length(high - low) / max(away, 1e-30), cos_c = group_boxes[at + 9u];
    if (sin_b >= cos_c) return false;
    return dot(axis, middle) > away * (sin_b * cos_c + sqrt((1.0 - sin_b * sin_b) * (1.0 - cos_c * cos_c)));
}
#else
const uint BOX = 6u;

bool all_back(uint at, vec3 low, vec3 high) { return false; }
#endif

void main() {
    uint group = gl_GlobalInvocationID.x;
    if (group >= scene.n_groups) return;
    uint at = group * BOX;
    vec3 low = against_eye(vec3(group_boxes[at], group_boxes[at + 1u], group_boxes[at + 2u]));
    vec3 high = against_eye(vec3(group_boxes[at + 3u], group_boxes[at + 4u], group_boxes[at + 5u]));
    bool visible = share_of(group) > 0.0 && in_view(low, high) && !all_back(at, low, high);
    uint chunk = last_chunk(group);
    for (uint batch = 0u; batch <= scene.n_batches; ++batch) {
        uint n_splats = batch < scene.n_batches ? counted_of(chunk, batch) : counted(chunk, scene.n_batches);
        Draw draw = Draw(visible ? 3u * n_splats : 0u, 1u, 0u, group * 4u * GROUP, 0u);
#ifdef LOOKED_UP
        Draw none = Draw(0u, 1u, 0u, group * 4u * GROUP, 0u);
        draws[(scene.n_batches + 1u + batch) * scene.n_groups + group] = looked_up[group] == 1u ? draw : none;
        if (looked_up[group] == 1u) draw = none;
#endif
        draws[batch * scene.n_groups + group] = draw;
    }
}
