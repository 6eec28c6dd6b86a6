"""Makes everything under ``assets/`` except ``avatar.onnx``: ``python -m assets.make`` from the repository's root."""
