// Keys and Gaussians move to their places; equal digits keep their order.

layout(std430, binding = 2) readonly buffer Gaussians { int gaussians[]; };
layout(std430, binding = 3) writeonly buffer NewKeys { uint new_keys[]; };
layout(std430, binding = 4) writeonly buffer NewGaussians { int new_gaussians[]; };
layout(std430, binding = 5) readonly buffer Starts { uint starts[]; };  // by block, by digit
#ifdef LAST_PASS
layout(r32i, binding = 0) writeonly uniform iimage2D order;
#endif

shared uint masks[256][8];  // of each digit, the threads that hold it
shared uint next[256];      // place of each digit's next key

void main() {
    uint thread = gl_LocalInvocationID.x, block = gl_WorkGroupID.x;
    uint word = thread / 32u, bit = 1u << (thread % 32u);
    next[thread] = starts[block * 256u + thread];
    for (int item = 0; item < ITEMS; item++) {
        for (int i = 0; i < 8; i++) masks[thread][i] = 0u;
        barrier();
        uint place = block * BLOCK + item * 256u + thread;
        bool used = place < count;
        uint key = used ? keys[place] : 0u, digit = digit_of(key);
        if (used) atomicOr(masks[digit][word], bit);
        barrier();
        if (used) {
            int before = bitCount(masks[digit][word] & (bit - 1u));
            for (uint i = 0u; i < word; i++) before += bitCount(masks[digit][i]);
            uint target = next[digit] + before;
#ifdef LAST_PASS
            ivec2 texel = ivec2(target % ROW_GAUSSIANS, target / ROW_GAUSSIANS);
            imageStore(order, texel, ivec4(gaussians[place]));
#else
            new_keys[target] = key;
            new_gaussians[target] = gaussians[place];
#endif
        }
        barrier();
        int held = 0;  // by all threads, of the digit that is this thread's number
        for (int i = 0; i < 8; i++) held += bitCount(masks[thread][i]);
        next[thread] += held;
        barrier();
    }
}
