// The image as it is handed out: outlines sharpened (outline.py), three numbers a pixel one after the other.

uniform sampler2D blended;  // premultiplied radiance; alpha

// By what a pixel's features grow; its coverage grows by as much.
float sharpening(float alpha) {
    return alpha * (3.0 - 2.0 * alpha);
}
