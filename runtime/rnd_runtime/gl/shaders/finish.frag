// Four of a row's numbers, red, green and blue of pixel after pixel; with TONE their 8-bit sRGB codes too.

uniform int width;  // px

layout(location = 0) out vec4 radiance;
#ifdef TONE
uniform sampler2D steps;  // [257] the least radiance of each code; infinity
layout(location = 1) out vec4 codes;  // over 255, exactly

// tone.py's _code: a guess by sRGB's formula, put right by the steps.
float code_of(float x) {
    if (!(x > 0.0)) return 0.0;
    x = min(x, 1.0);
    float srgb = x <= 0.0031308 ? 12.92 * x : 1.055 * pow(x, 1.0 / 2.4) - 0.055;
    int code = clamp(int(255.0 * srgb + 0.5), 0, 255);
    if (x < texelFetch(steps, ivec2(code, 0), 0).r) code--;
    else if (x >= texelFetch(steps, ivec2(code + 1, 0), 0).r) code++;
    return float(code) / 255.0;
}
#endif

void main() {
    ivec2 texel = ivec2(gl_FragCoord.xy);
    for (int k = 0; k < 4; k++) {
        int place = 4 * texel.x + k, channel = place % 3;
        vec4 pixel = texelFetch(blended, ivec2(min(place / 3, width - 1), texel.y), 0);
        float value = channel == 0 ? pixel.r : channel == 1 ? pixel.g : pixel.b;
        radiance[k] = value * sharpening(pixel.a);
#ifdef TONE
        codes[k] = code_of(radiance[k]);
#endif
    }
}
