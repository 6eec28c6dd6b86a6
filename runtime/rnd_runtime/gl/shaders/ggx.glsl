// shading/brdf.py's specular term from sin²θ_h and |l + v|².

float ggx(float alpha_squared, float n_dot_l, float n_dot_v, float sine_squared, float half_squared) {
    float lobe = sine_squared + alpha_squared * (1.0 - sine_squared);
    n_dot_l = max(n_dot_l, COSINE_FLOOR);
    n_dot_v = max(n_dot_v, COSINE_FLOOR);
    float shadowing = n_dot_l + sqrt(alpha_squared + (1.0 - alpha_squared) * n_dot_l * n_dot_l);
    float masking = n_dot_v + sqrt(alpha_squared + (1.0 - alpha_squared) * n_dot_v * n_dot_v);
    float grazing = max(1.0 - 0.5 * sqrt(half_squared), 0.0);
    float grazing_squared = grazing * grazing;
    float fresnel = F0 + (1.0 - F0) * grazing_squared * grazing_squared * grazing;
    return ONE_OVER_PI * alpha_squared * fresnel / (lobe * lobe * (shadowing * masking));
}
