// α of 3DGS and the premultiplied attributes, as in rnd_runtime/shaders.

flat in vec4 place;
flat in vec3 shape;
flat in vec3 attributes;
out vec4 target;

const float LOG2_ALPHA_MIN = -7.9943534368588578;  // log2(1/255)
const float ALPHA_MAX = 0.99;

void main() {
    vec2 d = gl_FragCoord.xy - place.xy;
    vec2 uv = vec2(shape.x * (d.x - shape.z * d.y), shape.y * d.y);
    float exponent = place.w - dot(uv, uv);
    if (!(exponent >= LOG2_ALPHA_MIN)) discard;
    float alpha = min(exp2(exponent), ALPHA_MAX);
    target = alpha * vec4(attributes, 1.0);
}
