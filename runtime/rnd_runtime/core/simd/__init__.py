"""Sixteen float32 lanes as one numba value.

``Lanes`` maps to LLVM's ``<16 x float>`` and ``Mask`` to ``<16 x i1>``: one AVX-512 instruction per operation, two of
AVX2, four of SSE or NEON.

numba's cache tracks only the file of the kernel it stored; ``core.kernels`` tracks these.
"""
