// Of a scene with maps: splats that are looked up have programs of their own.
uint map_of_it;
#ifdef ELLIPSOID
float its_z = ellipsoid.centre.z;
#else
float its_z = disc.centre.z;
#endif
if (is_looked_up(splat, its_z, map_of_it)) {
    gl_Position = vec4(2.0, 2.0, 2.0, 1.0);  // outside the picture
    return;
}
