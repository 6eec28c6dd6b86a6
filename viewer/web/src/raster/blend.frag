// The Gaussians of a pixel's tile, blended front to back by the rule of rnd_runtime/raster/oracle.py: a pixel stops before
// its transmittance falls below 1e-4. Then background and sRGB, or a material map (rnd_runtime/playback/aov.py).

uniform sampler2D records;   // TEXELS for each Gaussian; see project.js
uniform usampler2D pairs;    // Gaussians, tile by tile, front to back
uniform usampler2D tiles;    // first and last + 1 of a tile's pairs
uniform sampler2D sky;       // lat-long radiance
uniform ivec2 size;          // px
uniform ivec2 corner;        // px: where the part of the image begins that shows Gaussians,
uniform ivec2 extent;        // px: and its size
uniform int factor;          // pixels of the Gaussians' finer grid along a pixel's side
uniform int show;            // 0 radiance, 1 normals, 2 a number
uniform int background;      // 0 one colour, 1 the sky
uniform vec3 colour;         // linear
uniform mat3 pixel_to_light; // (column, row, 1) → direction in the light's frame
uniform sampler2D ground, sun0, sun1;  // blocked shares of the ground's light; of each sun's
uniform mat3 to_ground, to_sun0, to_sun1;  // (column, row, 1) → a map's row and column and 1, times a depth
uniform vec3 share0, share1;  // the suns' of the ground's light
uniform float gain;
uniform int curved;          // 1: tone curve "neutral"
out vec4 image;

const float PI = 3.14159265358979;

/** Premultiplied attributes and alpha. */
vec4 blend(ivec2 pixel) {
    uvec2 range = texelFetch(tiles, pixel / TILE, 0).xy;
    vec4 sum = vec4(0.0);
    float left = 1.0;
    for (uint pair = range.x; pair < range.y; pair++) {
        int gaussian = int(texelFetch(pairs, ivec2(pair % ROW_PAIRS, pair / ROW_PAIRS), 0).x);
        ivec2 texel = ivec2(gaussian % ROW_GAUSSIANS * TEXELS, gaussian / ROW_GAUSSIANS);
        vec4 centre = texelFetch(records, texel, 0), shape = texelFetch(records, texel + ivec2(1, 0), 0);
        vec2 d = vec2(pixel) - centre.xy - centre.zw;
        float across = d.x - shape.x * d.y;
        float exponent = shape.w - shape.y * d.y * d.y - shape.z * across * across;
        if (!(exponent >= LOG2_ALPHA_MIN)) continue;
        float weight = left * min(exp2(exponent), ALPHA_MAX);
        if (left - weight < TRANSMITTANCE_MIN) break;
        left -= weight;
        sum += weight * vec4(texelFetch(records, texel + ivec2(2, 0), 0).rgb, 1.0);
    }
    return sum;
}

/** The mean of a pixel's part of the finer grid, with outlines as sharp as a body's (rnd_runtime/raster/outline.py). */
vec4 mean_of(ivec2 pixel) {
    ivec2 first = (pixel - corner) * factor;
    if (any(lessThan(pixel, corner)) || any(greaterThanEqual(pixel, corner + extent))) return vec4(0.0);
    vec4 sum = vec4(0.0);
    for (int row = 0; row < factor; row++)
        for (int column = 0; column < factor; column++) {
            vec4 value = blend(first + ivec2(column, row));
            sum += value * value.a * (3.0 - 2.0 * value.a);
        }
    return sum / float(factor * factor);
}

vec3 texel(ivec2 at, ivec2 size) {
    return texelFetch(sky, ivec2((at.x + size.x) % size.x, clamp(at.y, 0, size.y - 1)), 0).rgb;
}

vec3 sample_sky(vec3 d) {
    ivec2 size = textureSize(sky, 0);
    float column = (0.5 + atan(d.z, d.x) / (2.0 * PI)) * float(size.x) - 0.5;
    float row = clamp(atan(length(d.xz), d.y) / PI * float(size.y) - 0.5, 0.0, float(size.y - 1));
    ivec2 corner = ivec2(floor(column), floor(row));
    vec2 part = vec2(column, row) - floor(vec2(column, row));
    vec3 upper = mix(texel(corner, size), texel(corner + ivec2(1, 0), size), part.x);
    vec3 lower = mix(texel(corner + ivec2(0, 1), size), texel(corner + ivec2(1, 1), size), part.x);
    return mix(upper, lower, part.y);
}

/** Bilinear; 0 outside of the map, and where the ground is not seen (rnd_runtime/ground/lookup.py). */
vec3 blocked(sampler2D map, mat3 to_map, vec2 at) {
    vec3 place = to_map * vec3(at, 1.0);
    ivec2 last = textureSize(map, 0).yx - 1;
    vec2 cell = place.xy / place.z;
    if (!(place.z > 1e-9) || any(lessThan(cell, vec2(0.0))) || any(greaterThan(cell, vec2(last)))) return vec3(0.0);
    ivec2 first = min(ivec2(cell), last - 1);
    vec2 part = cell - vec2(first);
    vec3 near = mix(texelFetch(map, first.yx, 0).rgb, texelFetch(map, first.yx + ivec2(1, 0), 0).rgb, part.y);
    vec3 far = mix(texelFetch(map, first.yx + ivec2(0, 1), 0).rgb, texelFetch(map, first.yx + 1, 0).rgb, part.y);
    return mix(near, far, part.x);
}

/** Share of the ground's light that the body leaves. */
vec3 left_on_ground(vec2 at) {
    vec3 sky = blocked(ground, to_ground, at);
    return max(1.0 - sky - share0 * blocked(sun0, to_sun0, at).r - share1 * blocked(sun1, to_sun1, at).r, 0.0);
}

vec3 srgb(vec3 linear) {
    vec3 x = max(linear, 0.0);
    return mix(1.055 * pow(x, vec3(1.0 / 2.4)) - 0.055, 12.92 * x, vec3(lessThanEqual(x, vec3(0.0031308))));
}

/** neutral of rnd_runtime/core/images.py. */
vec3 neutral(vec3 linear) {
    vec3 x = clamp(linear, 0.0, 1e30);
    float low = min(x.r, min(x.g, x.b));
    x -= low < 2.0 * NEUTRAL_OFFSET ? low - low * low / (4.0 * NEUTRAL_OFFSET) : NEUTRAL_OFFSET;
    float peak = max(x.r, max(x.g, x.b)), room = 1.0 - NEUTRAL_START;
    if (peak <= NEUTRAL_START) return x;
    float compressed = 1.0 - room * room / (peak - NEUTRAL_START + room);
    return mix(vec3(compressed), x / peak * compressed, 1.0 / (NEUTRAL_DESATURATION * (peak - compressed) + 1.0));
}

void main() {
    ivec2 at = ivec2(int(gl_FragCoord.x), size.y - 1 - int(gl_FragCoord.y));
    vec4 value = mean_of(at);
    vec3 result;
    if (show == 0) {
        vec3 far = background == 1 ? gain * sample_sky(pixel_to_light * vec3(vec2(at) + 0.5, 1.0)) : colour;
        far *= left_on_ground(vec2(at) + 0.5);
        float a = value.a > 0.0 ? value.a : 1.0;
        vec3 light = value.rgb + (1.0 - value.a) * far;
        if (curved == 1) light = background == 1 ? neutral(light) : a * neutral(value.rgb / a) + (1.0 - value.a) * far;
        result = srgb(light);
    } else if (value.a < MIN_COVERAGE) {
        result = vec3(0.0);
    } else {
        vec3 mean = value.rgb / value.a;
        result = show == 1 ? (mean / max(length(mean), 1e-6) + 1.0) / 2.0 : mean.rrr;
    }
    image = vec4(result, 1.0);
}
