// How many keys of each block have each digit.

layout(std430, binding = 5) writeonly buffer Counts { uint counts[]; };  // by block, by digit

shared uint own_counts[256];

void main() {
    uint thread = gl_LocalInvocationID.x, block = gl_WorkGroupID.x;
    own_counts[thread] = 0u;
    barrier();
    for (int item = 0; item < ITEMS; item++) {
        uint place = block * BLOCK + item * 256u + thread;
        if (place < count) atomicAdd(own_counts[digit_of(keys[place])], 1u);
    }
    barrier();
    counts[block * 256u + thread] = own_counts[thread];
}
