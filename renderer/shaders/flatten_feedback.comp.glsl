// The feedback buffer as a list of pages (2020, section 4.2; Hollemeersch et al. 2010): an invocation a page; the buffer is
// empty after it.

layout(local_size_x = 64) in;
layout(std430, binding = 14) buffer Feedback { uvec2 feedback[]; };
layout(std430, binding = 17) buffer Listed { uint n_listed, spare[3]; uvec4 listed[]; };  // page, fragments in the view, in its margin
uniform uint n_pages;

void main() {
    uint page = gl_GlobalInvocationID.x;
    if (page >= n_pages) return;
    uvec2 found = feedback[page];
    if (found.x + found.y == 0u) return;
    feedback[page] = uvec2(0u);
    uint row = atomicAdd(n_listed, 1u);
    if (row < uint(listed.length())) listed[row] = uvec4(page, found, 0u);
}
