// Orthographic depth maps of the directional lights, one below the other, as shadow.py lays them out: texel centres at integers.

uniform mat3 light_axes[LIGHTS];  // world → two axes across the light's direction and the direction itself
uniform sampler2D bounds;     // a texel a light: −left, −bottom, right, top m

struct MapPoint {
    vec3 position;  // x, y texels; z m towards the light
    float cosine;   // of the normal with the light's direction
    vec2 slope;     // rise of the tangent plane towards the light, m a texel
    float texel;    // m
};

MapPoint in_map(int light, vec3 mean, vec3 normal_world) {
    vec4 around = texelFetch(bounds, ivec2(light, 0), 0);
    float extent = max(around.x + around.z, around.y + around.w);
    if (!(extent > 0.0)) extent = 1.0;  // a single point, or none: nothing to cast
    float texel = extent / float(MAP_SIZE - 3);
    vec3 position = light_axes[light] * mean, turned = light_axes[light] * normal_world;
    position.xy = (position.xy + around.xy) / texel + 1.0;
    return MapPoint(position, turned.z, turned.xy * (-texel / max(turned.z, SLOPE_FLOOR)), texel);
}

bool usable(vec3 mean, vec3 normal_world, float radius) {
    float sum = mean.x + mean.y + mean.z + normal_world.x + normal_world.y + normal_world.z + radius;
    return abs(sum) < 1e30;  // NaN fails
}
