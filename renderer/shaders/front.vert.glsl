    // The eye is behind the disc: its back. Tangents and normal are right-handed in camera axes too.
    if (dot(cross(disc.u, disc.v), disc.centre) >= 0.0) {
        gl_Position = vec4(2.0, 2.0, 2.0, 1.0);
        return;
    }
