// Frames from rnd-view over a websocket. Static pages have another engine.js.

const WITH_BODY = ["frame", "clip", "truth"];
const UNREACHABLE = "rnd-view does not answer; is it still running?";

/**
 * Connect. `on` gets: scene(description), frame({number, width, height, joints, times, image}), truth(index, bitmap or
 * null where the browser cannot decode it), progress(done, of, note or nothing), clip(blob, name, notes), error(text, ends):
 * of a frame or of a clip, which ends with it by default. None of them is called before what asks for it has
 * returned.
 */
export async function connect(on) {
  const address = new URL("socket", location.href);
  address.protocol = address.protocol.replace("http", "ws");
  address.search = location.search;
  const socket = new WebSocket(address);
  socket.binaryType = "arraybuffer";
  let header = null;  // of the binary message to come
  socket.onmessage = ({ data }) => {
    if (typeof data === "string") {
      header = JSON.parse(data);
      if (WITH_BODY.includes(header.kind)) return;
    }
    receive(header, data, on);
  };
  socket.onclose = () => on.error(UNREACHABLE);
  // raw pixels are exact, and as fast on the same machine
  const local = ["127.0.0.1", "localhost", "[::1]"].includes(location.hostname);
  const encoding = new URLSearchParams(location.search).get("encoding") ?? (local ? "raw" : "jpeg");
  const send = (request) => {
    if (socket.readyState === WebSocket.OPEN) socket.send(JSON.stringify(request));
    else queueMicrotask(() => on.error(UNREACHABLE));
  };
  return {
    render: (number, state, exact) => send({ ask: "render", number, live: !exact, state: { ...state, encoding: exact ? "raw" : encoding } }),
    clip: (state, fps, turn) => send({ ask: "clip", state, fps, turn }),
    truth: (index) => send({ ask: "truth", index }),
  };
}

async function receive(header, body, on) {
  if (header.kind === "scene") on.scene(header.scene);
  else if (header.kind === "error") on.error(header.message);
  else if (header.kind === "progress") on.progress(header.done, header.of);
  else if (header.kind === "clip") on.clip(new Blob([body], { type: "video/mp4" }), "clip.mp4", header.notes);
  else if (header.kind === "truth") on.truth(header.index, await createImageBitmap(new Blob([body])).catch(() => null));
  else {
    const image = await pixels(header, body).catch(() => null);
    if (image) on.frame({ ...header, image });
    else on.error("this browser cannot decode an image that rnd-view sent", false);
  }
}

async function pixels({ encoding, width, height }, body) {
  if (encoding === "raw") return new ImageData(new Uint8ClampedArray(body), width, height);
  return createImageBitmap(new Blob([body], { type: "image/jpeg" }));
}
