// What counting and scattering share: 8 bits of the keys at a time, in blocks of ITEMS · 256.

layout(local_size_x = 256) in;
layout(std430, binding = 1) readonly buffer Keys { uint keys[]; };
uniform int count;   // keys
uniform int shift;   // of the bits that are looked at

const int ITEMS = BLOCK / 256;

uint digit_of(uint key) {
    return (key >> shift) & 255u;
}
