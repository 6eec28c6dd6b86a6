// α of 3DGS and the premultiplied attributes, three to a target; every target's own alpha is α.
// The program's head defines OUTPUTS and WRITES, one statement for each target: with an array of outputs, or an
// attribute picked in a loop, llvmpipe goes through memory for every pixel (260 ms instead of 17).

// Not u and v themselves: interpolated over an image of 4096 pixels they lose a ten thousandth of a pixel, and Mesa 22 clips
// `noperspective` varyings wrongly where an edge lies on the border (α 0.01 instead of 0.9).
uniform vec2 size;     // px
flat in vec3 centre;   // from the image's middle px; log2 of the opacity
flat in vec3 ellipse;  // see splat.vert
flat in vec4 attributes[(ATTRIBUTES + 3) / 4];

OUTPUTS

void main() {
    vec2 d = gl_FragCoord.xy - 0.5 * size - centre.xy;
    vec2 uv = ellipse.xy * vec2(d.x - ellipse.z * d.y, d.y);
    float exponent = centre.z - dot(uv, uv);
    if (!(exponent >= LOG2_ALPHA_MIN)) discard;
    float alpha = min(exp2(exponent), ALPHA_MAX);
    WRITES
}
