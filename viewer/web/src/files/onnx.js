// Subgraphs of an ONNX file (rnd_runtime/avatar/onnx_parts.py): onnxruntime computes every node of a graph.

// Field numbers of onnx.proto
const MODEL_GRAPH = 7, MODEL_METADATA = 14;
const GRAPH_NODE = 1, GRAPH_INITIALIZER = 5, GRAPH_INPUT = 11, GRAPH_OUTPUT = 12, GRAPH_VALUE_INFO = 13;
const NODE_INPUT = 1, NODE_OUTPUT = 2, TENSOR_NAME = 8, NAME = 1;
const LENGTH = 2;  // wire type

const text = (bytes) => new TextDecoder().decode(bytes);

export class OnnxFile {
  /** `metadata`: of metadata_props; `outputs`: names. Throws for other or truncated files. */
  constructor(bytes) {
    Object.assign(this, { head: [], graphHead: [], nodes: [], constants: new Map(), inputs: new Map(), outputs: new Set(), metadata: new Map() });
    for (const [field, value, record] of fields(bytes)) {
      if (field === MODEL_GRAPH && value) this.readGraph(value);
      else this.head.push(record);
      if (field === MODEL_METADATA && value) {
        const entry = new Map(fields(value));
        if (entry.get(1)) this.metadata.set(text(entry.get(1)), text(entry.get(2) ?? new Uint8Array()));
      }
    }
  }

  readGraph(graph) {
    for (const [field, value, record] of fields(graph)) {
      const named = (number) => [...fields(value)].filter(([part]) => part === number).map(([, bytes]) => text(bytes));
      if (field === GRAPH_NODE) this.nodes.push({ inputs: named(NODE_INPUT), outputs: named(NODE_OUTPUT), record });
      else if (field === GRAPH_INITIALIZER) this.constants.set(named(TENSOR_NAME)[0], record);
      else if (field === GRAPH_INPUT) this.inputs.set(named(NAME)[0], record);
      else if (field === GRAPH_OUTPUT) this.outputs.add(named(NAME)[0]);
      else if (field !== GRAPH_VALUE_INFO) this.graphHead.push(record);  // onnxruntime infers shapes
    }
  }

  /** A model that computes only `outputs`, any values of the graph; `inputs`: the names it needs. */
  cut(outputs) {
    const wanted = new Set(outputs), nodes = [];
    for (const node of this.nodes.toReversed()) {  // ONNX demands topological order
      if (!node.outputs.some((name) => wanted.has(name))) continue;
      nodes.unshift(node.record);
      for (const name of node.inputs) wanted.add(name);
    }
    const needed = (values) => [...values].filter(([name]) => wanted.has(name)).map(([, record]) => record);
    const given = outputs.map((name) => field(GRAPH_OUTPUT, field(NAME, new TextEncoder().encode(name))));
    const graph = joined([...this.graphHead, ...nodes, ...needed(this.constants), ...needed(this.inputs), ...given]);
    const inputs = [...this.inputs.keys()].filter((name) => wanted.has(name));
    return { model: joined([...this.head, field(MODEL_GRAPH, graph)]), inputs };
  }
}

/** [number, bytes or null, all bytes] of a protocol buffer message's fields; null where the field is a number. */
function* fields(bytes) {
  let at = 0;
  const varint = () => {
    let value = 0;
    for (let shift = 1; ; shift *= 128) {
      if (at >= bytes.length) throw new Error("the .onnx file is cut short");
      const byte = bytes[at++];
      value += (byte & 127) * shift;
      if (byte < 128) return value;
    }
  };
  while (at < bytes.length) {
    const start = at, tag = varint(), wire = tag % 8;
    let value = null;
    if (wire === LENGTH) {
      const length = varint();
      if (at + length > bytes.length) throw new Error("the .onnx file is cut short");
      value = bytes.subarray(at, at += length);
    } else {
      if (wire === 0) varint();
      else if (wire === 1) at += 8;
      else if (wire === 5) at += 4;
      else throw new Error("not an .onnx file");
    }
    yield [Math.floor(tag / 8), value, bytes.subarray(start, at)];
  }
}

/** A field of bytes. */
const field = (number, bytes) => joined([coded(number * 8 + LENGTH), coded(bytes.length), bytes]);

function coded(number) {
  const bytes = [];
  for (; number > 127; number = Math.floor(number / 128)) bytes.push(number % 128 + 128);
  return Uint8Array.from([...bytes, number]);
}

function joined(parts) {
  const all = new Uint8Array(parts.reduce((total, part) => total + part.length, 0));
  let at = 0;
  for (const part of parts) {
    all.set(part, at);
    at += part.length;
  }
  return all;
}
