// Nearest and farthest depth of what is drawn, by one group.

layout(local_size_x = THREADS) in;
layout(std430, binding = 0) writeonly buffer Range { double nearest, farthest; };

shared double low[THREADS], high[THREADS];

void main() {
    int own = int(gl_LocalInvocationID.x);
    low[own] = 1e300lf;
    high[own] = -1e300lf;
    for (int i = own; i < count; i += THREADS) {
        double depth;
        if (depth_of(i, depth)) {
            low[own] = min(low[own], depth);
            high[own] = max(high[own], depth);
        }
    }
    for (int reach = THREADS / 2; reach > 0; reach /= 2) {
        barrier();
        if (own < reach) {
            low[own] = min(low[own], low[own + reach]);
            high[own] = max(high[own], high[own + reach]);
        }
    }
    if (own == 0) {
        nearest = low[0];
        farthest = high[0];
    }
}
