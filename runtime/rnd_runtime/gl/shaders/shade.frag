// The radiance that the Gaussian of this rank sends to the camera.

uniform isampler2D order;  // the Gaussian of each rank, −1 where none is drawn
uniform int count;         // ranks

out vec4 radiance;  // its fourth component is 0 where it is no number, and 1 elsewhere

void main() {
    ivec2 texel = ivec2(gl_FragCoord.xy);
    if (texel.y * ROW_GAUSSIANS + texel.x >= count) discard;
    int gaussian = texelFetch(order, texel, 0).r;
    radiance = vec4(0.0);
    if (gaussian < 0) return;
    load_surface(gaussian);
    vec3 linear = sky();
#ifdef LIGHTS
    linear += direct();
#endif
    bool none = isnan(checksum) || isinf(checksum) || any(isnan(linear)) || any(isinf(linear));
    radiance = none ? vec4(0.0) : vec4(linear, 1.0);
}
