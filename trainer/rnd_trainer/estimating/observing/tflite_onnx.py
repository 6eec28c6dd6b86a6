"""Conversion of TensorFlow Lite networks to ONNX: the operators of BlazePose's detector, landmarks and hands.

The graph keeps the input's layout [1, H, W, C] and computes in [1, C, H, W]. Weights become float32.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from rnd_runtime.cli.extras import need_packages
from rnd_runtime.core.errors import InputError

if TYPE_CHECKING:
    import onnx

Array = NDArray[Any]

OPSET = 17
IR_VERSION = 8
_TO_CHANNELS_FIRST, _TO_CHANNELS_LAST = [0, 3, 1, 2], [0, 2, 3, 1]
_SAME = 0  # of TensorFlow Lite's enumeration of paddings


def convert(model: bytes, name: str) -> onnx.ModelProto:
    """The network ``model`` (the content of a .tflite file) as ONNX.

    Its input is ``image``, its outputs are ``out0``, ``out1``, … in the order and shapes of the original.

    Raises:
        InputError: a package is missing, or the network has an operator or activation beyond those known here.
    """
    need_packages("data", "tflite", "onnx")
    return _Conversion(model, name).model()


class _Conversion:
    def __init__(self, model: bytes, name: str) -> None:
        import tflite

        self.tflite = tflite
        self.name = name
        self.source = tflite.Model.GetRootAsModel(model, 0)
        self.graph = self.source.Subgraphs(0)
        self.codes = {value: key for key, value in vars(tflite.BuiltinOperator).items() if isinstance(value, int)}
        self.constants: dict[int, Array] = {}  # computed ones: dequantised, dense
        self.nodes: list[Any] = []
        self.initializers: list[Any] = []

    def model(self) -> onnx.ModelProto:
        from onnx import TensorProto, helper

        source, outputs = int(self.graph.Inputs(0)), [int(index) for index in self.graph.OutputsAsNumpy()]
        self._add("Transpose", ["image"], _value(source), perm=_TO_CHANNELS_FIRST)
        for index in range(self.graph.OperatorsLength()):
            self._operator(self.graph.Operators(index))
        declared = []
        for k, index in enumerate(outputs):
            shape = self._shape(index)
            if len(shape) == 4:
                self._add("Transpose", [_value(index)], f"out{k}", perm=_TO_CHANNELS_LAST)
            else:
                self._add("Identity", [_value(index)], f"out{k}")
            declared.append(helper.make_tensor_value_info(f"out{k}", TensorProto.FLOAT, shape))
        image = helper.make_tensor_value_info("image", TensorProto.FLOAT, self._shape(source))
        graph = helper.make_graph(self.nodes, self.name, [image], declared, self.initializers)
        return helper.make_model(graph, opset_imports=[helper.make_opsetid("", OPSET)], ir_version=IR_VERSION)

    # --- operators -------------------------------------------------------------------------------------------------

    def _operator(self, operator: Any) -> None:
        code = self.source.OperatorCodes(operator.OpcodeIndex())
        kind = self.codes[max(code.BuiltinCode(), code.DeprecatedBuiltinCode())]
        convert_one = getattr(self, f"_{kind.lower()}_op", None)
        if convert_one is None:
            raise InputError(f"network {self.name}", expected="an operator known here", got=kind)
        convert_one(operator, [int(index) for index in operator.InputsAsNumpy()], int(operator.Outputs(0)))

    def _dequantize_op(self, _: Any, inputs: list[int], output: int) -> None:
        self.constants[output] = self._constant(inputs[0]).astype(np.float32)

    def _densify_op(self, _: Any, inputs: list[int], output: int) -> None:
        tensor = self.graph.Tensors(inputs[0])
        self.constants[output] = _dense(self._stored(inputs[0]), self._shape(inputs[0]), tensor.Sparsity())

    def _conv_2d_op(self, operator: Any, inputs: list[int], output: int) -> None:
        options = self._options(operator, self.tflite.Conv2DOptions)
        weights = self._constant(inputs[1]).transpose(0, 3, 1, 2)
        self._convolution(options, weights, 1, inputs, output)

    def _depthwise_conv_2d_op(self, operator: Any, inputs: list[int], output: int) -> None:
        options = self._options(operator, self.tflite.DepthwiseConv2DOptions)
        weights = self._constant(inputs[1]).transpose(3, 0, 1, 2)
        self._convolution(options, weights, self._shape(inputs[0])[3], inputs, output)

    def _convolution(self, options: Any, weights: Array, groups: int, inputs: list[int], output: int) -> None:
        strides, dilations = (
            [options.StrideH(), options.StrideW()],
            [options.DilationHFactor(), options.DilationWFactor()],
        )
        pads = self._pads(options.Padding(), inputs[0], list(weights.shape[2:]), strides, dilations)
        names = [_value(inputs[0]), self._initializer(weights), self._initializer(self._constant(inputs[2]))]
        result = self._add("Conv", names, strides=strides, dilations=dilations, pads=pads, group=groups)
        self._activate(result, options.FusedActivationFunction(), output)

    def _fully_connected_op(self, operator: Any, inputs: list[int], output: int) -> None:
        options = self._options(operator, self.tflite.FullyConnectedOptions)
        weights = self._constant(inputs[1])
        flat = self._flat(inputs[0], [1, weights.shape[1]])
        names = [flat, self._initializer(weights), self._initializer(self._constant(inputs[2]))]
        self._activate(self._add("Gemm", names, transB=1), options.FusedActivationFunction(), output)

    def _max_pool_2d_op(self, operator: Any, inputs: list[int], output: int) -> None:
        options = self._options(operator, self.tflite.Pool2DOptions)
        size, strides = [options.FilterHeight(), options.FilterWidth()], [options.StrideH(), options.StrideW()]
        pads = self._pads(options.Padding(), inputs[0], size, strides, [1, 1])
        self._add("MaxPool", [_value(inputs[0])], _value(output), kernel_shape=size, strides=strides, pads=pads)

    def _add_op(self, operator: Any, inputs: list[int], output: int) -> None:
        options = self._options(operator, self.tflite.AddOptions)
        self._activate(self._add("Add", [_value(index) for index in inputs]), options.FusedActivationFunction(), output)

    def _pad_op(self, _: Any, inputs: list[int], output: int) -> None:
        amounts = self._constant(inputs[1])[_TO_CHANNELS_FIRST]
        pads = self._initializer(np.concatenate([amounts[:, 0], amounts[:, 1]]).astype(np.int64))
        self._add("Pad", [_value(inputs[0]), pads], _value(output))

    def _mean_op(self, _: Any, inputs: list[int], output: int) -> None:
        axes = sorted({_TO_CHANNELS_FIRST.index(int(axis)) for axis in self._constant(inputs[1]).reshape(-1)})
        kept = len(self._shape(output)) == 4
        self._add("ReduceMean", [_value(inputs[0])], _value(output), axes=axes, keepdims=int(kept))

    def _resize_bilinear_op(self, operator: Any, inputs: list[int], output: int) -> None:
        options = self._options(operator, self.tflite.ResizeBilinearOptions)
        mode = "align_corners" if options.AlignCorners() else "asymmetric"
        mode = "half_pixel" if options.HalfPixelCenters() else mode
        sizes = self._initializer(np.array(self._shape(output), np.int64)[_TO_CHANNELS_FIRST])
        names = [_value(inputs[0]), "", "", sizes]
        self._add("Resize", names, _value(output), mode="linear", coordinate_transformation_mode=mode)

    def _depth_to_space_op(self, operator: Any, inputs: list[int], output: int) -> None:
        size = self._options(operator, self.tflite.DepthToSpaceOptions).BlockSize()
        self._add("DepthToSpace", [_value(inputs[0])], _value(output), blocksize=size, mode="DCR")

    def _concatenation_op(self, operator: Any, inputs: list[int], output: int) -> None:
        axis, rank = self._options(operator, self.tflite.ConcatenationOptions).Axis(), len(self._shape(output))
        axis = _TO_CHANNELS_FIRST.index(axis % rank) if rank == 4 else axis % rank
        self._add("Concat", [_value(index) for index in inputs], _value(output), axis=axis)

    def _reshape_op(self, _: Any, inputs: list[int], output: int) -> None:
        self._flat(inputs[0], self._shape(output), _value(output))

    def _logistic_op(self, _: Any, inputs: list[int], output: int) -> None:
        self._add("Sigmoid", [_value(inputs[0])], _value(output))

    # --- parts -----------------------------------------------------------------------------------------------------

    def _flat(self, index: int, shape: list[int], output: str | None = None) -> str:
        """``index`` in the original's order of elements, reshaped to at most three axes."""
        name = _value(index)
        if len(self._shape(index)) == 4:
            name = self._add("Transpose", [name], perm=_TO_CHANNELS_LAST)
        return self._add("Reshape", [name, self._initializer(np.array(shape, np.int64))], output)

    def _activate(self, name: str, activation: int, output: int) -> None:
        kinds = self.tflite.ActivationFunctionType
        if activation == kinds.NONE:
            self._add("Identity", [name], _value(output))
        elif activation == kinds.RELU:
            self._add("Relu", [name], _value(output))
        elif activation == kinds.RELU6:
            limits = [self._initializer(np.float32(limit)) for limit in (0, 6)]
            self._add("Clip", [name, *limits], _value(output))
        else:
            raise InputError(f"network {self.name}", expected="ReLU or none", got=f"activation {activation}")

    def _pads(self, padding: int, index: int, size: list[int], strides: list[int], dilations: list[int]) -> list[int]:
        """Zeros before and after each axis: TensorFlow puts the odd one after."""
        if padding != _SAME:
            return [0, 0, 0, 0]
        before, after = [], []
        for side, kernel, stride, dilation in zip(self._shape(index)[1:3], size, strides, dilations):
            total = max((-(-side // stride) - 1) * stride + (kernel - 1) * dilation + 1 - side, 0)
            before.append(total // 2)
            after.append(total - total // 2)
        return [*before, *after]

    def _add(self, kind: str, inputs: list[str], output: str | None = None, **attributes: Any) -> str:
        from onnx import helper

        output = output or f"n{len(self.nodes)}"
        self.nodes.append(helper.make_node(kind, inputs, [output], **attributes))
        return output

    def _initializer(self, values: Any) -> str:
        from onnx import numpy_helper

        name = f"c{len(self.initializers)}"
        self.initializers.append(numpy_helper.from_array(np.ascontiguousarray(values), name))
        return name

    def _options(self, operator: Any, kind: type[Any]) -> Any:
        options, table = kind(), operator.BuiltinOptions()
        options.Init(table.Bytes, table.Pos)
        return options

    def _shape(self, index: int) -> list[int]:
        return [int(size) for size in self.graph.Tensors(index).ShapeAsNumpy()]

    def _constant(self, index: int) -> Array:
        known = self.constants.get(index)
        return self._stored(index).reshape(self._shape(index)) if known is None else known

    def _stored(self, index: int) -> Array:
        tensor = self.graph.Tensors(index)
        kinds = self.tflite.TensorType
        types = {kinds.FLOAT32: np.float32, kinds.FLOAT16: np.float16, kinds.INT32: np.int32}
        buffer = self.source.Buffers(tensor.Buffer())
        if tensor.Type() not in types or buffer.DataLength() == 0:
            raise InputError(f"network {self.name}", expected="a constant of known type", got=str(tensor.Name()))
        return np.frombuffer(buffer.DataAsNumpy().tobytes(), types[tensor.Type()])


def _value(index: int) -> str:
    return f"t{index}"


def _dense(values: Array, shape: list[int], sparsity: Any) -> Array:
    """A tensor of which the innermost axis is stored sparsely, by row."""
    segments, indices = _row_index(sparsity, len(shape) - 1)
    dense = np.zeros((int(np.prod(shape[:-1])), shape[-1]), values.dtype)
    rows = np.repeat(np.arange(len(dense)), np.diff(segments))
    dense[rows, indices] = values
    return dense.reshape(shape)


def _row_index(sparsity: Any, axis: int) -> tuple[Array, Array]:
    """Where each row's values begin, and their columns."""
    import tflite

    kinds = {
        tflite.SparseIndexVector.Int32Vector: tflite.Int32Vector,
        tflite.SparseIndexVector.Uint16Vector: tflite.Uint16Vector,
        tflite.SparseIndexVector.Uint8Vector: tflite.Uint8Vector,
    }
    stored = sparsity.DimMetadata(axis)
    if sparsity.BlockMapLength() or stored.Format() != tflite.DimensionType.SPARSE_CSR:
        raise InputError("network", expected="weights that are sparse along the last axis", got="others")
    found = []
    pairs = (stored.ArraySegments(), stored.ArraySegmentsType()), (stored.ArrayIndices(), stored.ArrayIndicesType())
    for table, kind in pairs:
        vector = kinds[kind]()
        vector.Init(table.Bytes, table.Pos)
        found.append(vector.ValuesAsNumpy().astype(np.int64))
    return found[0], found[1]
