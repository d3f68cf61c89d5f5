// With what share a group is drawn beside those of other levels that stand for the same surface, see renderer/splats/detail.py.

#ifdef DETAIL
layout(std430, binding = 11) readonly buffer Shares { float shares[]; };  // of each group
const float HIDES_FROM = 0.5;  // the share from which on a group hides what lies behind it: one of a level and the next always does

float share_of(uint group) { return shares[group]; }
#else
const float HIDES_FROM = 0.0;

float share_of(uint group) { return 1.0; }
#endif
