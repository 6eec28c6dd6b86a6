// Four harmonics of a Gaussian's visibility.

out vec4 harmonics;

void main() {
    ivec2 texel = ivec2(gl_FragCoord.xy);
    int gaussian = texel.y * ROW_GAUSSIANS + texel.x / 4;
    if (gaussian >= GAUSSIANS) discard;
    find_neighbours(gaussian);
    harmonics = field(8 + texel.x % 4);
}
