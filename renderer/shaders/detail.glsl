// With what share a group is drawn beside those of other levels that stand for the same surface, see renderer/splats/detail.py.

#ifdef DETAIL
layout(std430, binding = 11) readonly buffer Shares { float shares[]; };  // of each group
const float HIDES_FROM = 0.5;  // the share from which on a group hides what lies behind it: one of a level and the next always does

// 2 is added to the share of groups that stand in for finer ones that are not here yet: seen from nearer than they are made for, they would have
// pinholes, so their splats are larger. The viewer's alone (services/web/viewer/detail.js).
const float STANDS_IN = 2.0, GROWTH = 2.0;
#define GROWTH_OF(group) (shares[group] < STANDS_IN ? 1.0 : GROWTH)

float share_of(uint group) { return shares[group] - (shares[group] < STANDS_IN ? 0.0 : STANDS_IN); }
#else
const float HIDES_FROM = 0.0;

float share_of(uint group) { return 1.0; }
#endif
