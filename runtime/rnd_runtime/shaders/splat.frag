// α of 3DGS and the premultiplied attributes, three to a target; every target's own alpha is α.
// The program's head defines OUTPUTS and WRITES, one statement for each target: with an array of outputs, or an
// attribute picked in a loop, llvmpipe goes through memory for every pixel (260 ms instead of 17).

in vec3 whitened;
flat in vec4 attributes[(ATTRIBUTES + 3) / 4];

OUTPUTS

const float LOG2_ALPHA_MIN = -7.9943534368588578;  // log2(1/255)
const float ALPHA_MAX = 0.99;

void main() {
    float exponent = whitened.z - dot(whitened.xy, whitened.xy);
    if (!(exponent >= LOG2_ALPHA_MIN)) discard;
    float alpha = min(exp2(exponent), ALPHA_MAX);
    WRITES
}
