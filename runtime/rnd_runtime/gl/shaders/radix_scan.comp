// Counts become where the keys of each block with each digit begin; one group, a thread for each digit.

layout(local_size_x = 256) in;
layout(std430, binding = 5) buffer Counts { uint counts[]; };  // by block, by digit
uniform int blocks;

shared uint totals[256];

void main() {
    uint digit = gl_LocalInvocationID.x;
    uint total = 0u;
    for (int block = 0; block < blocks; block++) total += counts[block * 256 + digit];
    totals[digit] = total;
    for (uint reach = 1u; reach < 256u; reach *= 2u) {  // Hillis and Steele (1986)
        barrier();
        uint before = digit >= reach ? totals[digit - reach] : 0u;
        barrier();
        totals[digit] += before;
    }
    uint start = totals[digit] - total;
    for (int block = 0; block < blocks; block++) {
        uint own = counts[block * 256 + digit];
        counts[block * 256 + digit] = start;
        start += own;
    }
}
