// shading/sum.py: the sum over distant lights, each with the whole BRDF and the visibility towards it.

uniform sampler2D distant;  // six texels a light, ROW_LIGHTS lights a row: direction, flux.r; flux.g, flux.b; SH coefficients
uniform int lights;

vec3 sky() {
    vec3 scattered = vec3(0.0), reflected = vec3(0.0);
    float alpha2 = alpha_squared();
    for (int k = 0; k < lights; k++) {
        ivec2 texel = ivec2(6 * (k % ROW_LIGHTS), k / ROW_LIGHTS);
        vec4 first = texelFetch(distant, texel, 0);
        vec3 flux = vec3(first.w, texelFetch(distant, texel + ivec2(1, 0), 0).xy);
        float visible = dot(coefficients[0], texelFetch(distant, texel + ivec2(2, 0), 0));
        visible += dot(coefficients[1], texelFetch(distant, texel + ivec2(3, 0), 0));
        visible += dot(coefficients[2], texelFetch(distant, texel + ivec2(4, 0), 0));
        visible += dot(coefficients[3], texelFetch(distant, texel + ivec2(5, 0), 0));
        vec3 h = first.xyz + view;
        float half_squared = max(dot(h, h), HALF_FLOOR);
        // sin²θ_h by the cross product: 1 − (n·h)² would lose the highlights of α ≈ 0.01 to rounding
        vec3 across = cross(normal, h);
        float n_dot_l = dot(normal, first.xyz);
        vec3 visible_irradiance = visible * max(n_dot_l, 0.0) * flux;
        scattered += visible_irradiance;
        reflected += visible_irradiance * ggx(alpha2, n_dot_l, n_dot_v, dot(across, across) / half_squared, half_squared);
    }
    return max(ONE_OVER_PI * albedo * scattered + specular_share * reflected, 0.0);
}
