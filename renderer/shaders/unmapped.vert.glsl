// Of a scene with maps: splats that are looked up have programs of their own.
uint map_of_it;
#ifdef ELLIPSOID
vec3 its_middle = ellipsoid.centre;
#else
vec3 its_middle = disc.centre;
#endif
if (share_looked_up(splat, its_middle, map_of_it) > 0.0) {
    gl_Position = vec4(2.0, 2.0, 2.0, 1.0);  // outside the picture
    return;
}
