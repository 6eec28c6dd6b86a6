flat in vec4 around;
out vec4 value;

void main() {
    value = around;
}
