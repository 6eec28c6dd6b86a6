// The coverage, one number a pixel.

out float alpha;

void main() {
    float covered = texelFetch(blended, ivec2(gl_FragCoord.xy), 0).a;
    alpha = covered * sharpening(covered);
}
