// Where the streams of a group and batch begin; derived at load, see group_table() of scene.py. Needs find_splat.glsl.

layout(std430, binding = 3) readonly buffer Groups { uint groups[]; };  // 2 + 2 n_batches words a group

uint group_row(uint group) { return group * (2u + 2u * scene.n_batches); }
uint code_word(uint group) { return groups[group_row(group)]; }
uint clipline_word(uint group) { return groups[group_row(group) + 1u]; }
uint first_entry(uint group) { return groups[group_row(group) + 2u + 2u * batch]; }
uint first_ellipsoid(uint group) { return groups[group_row(group) + 3u + 2u * batch]; }  // a word of the whole stream
uint first_clipline(uint group) { return groups[group_row(group) + 3u + 2u * batch]; }
