// The pictures come from rnd-view over a websocket. A page served without it brings an engine.js of its own.

const WITH_BODY = ["picture", "clip", "truth"];
const UNREACHABLE = "rnd-view does not answer; is it still running?";

/**
 * Connect. `on` gets: scene(description), picture({number, width, height, joints, times, image}), truth(index, bitmap),
 * progress(done, of), clip(blob, name), error(text, ends): of a picture or of a clip, which ends with it unless told otherwise.
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
  // Raw pixels are exact, and no slower while no wire is in between.
  const local = ["127.0.0.1", "localhost", "[::1]"].includes(location.hostname);
  const encoding = new URLSearchParams(location.search).get("encoding") ?? (local ? "raw" : "jpeg");
  const send = (request) => { if (socket.readyState === WebSocket.OPEN) socket.send(JSON.stringify(request)); };
  return {
    render: (number, state, exact) => send({ ask: "render", number, state: { ...state, encoding: exact ? "raw" : encoding } }),
    clip: (state, fps, turn) => send({ ask: "clip", state, fps, turn }),
    truth: (index) => send({ ask: "truth", index }),
  };
}

async function receive(header, body, on) {
  if (header.kind === "scene") on.scene(header.scene);
  else if (header.kind === "error") on.error(header.message);
  else if (header.kind === "progress") on.progress(header.done, header.of);
  else if (header.kind === "clip") on.clip(new Blob([body], { type: "video/mp4" }), "clip.mp4");
  else if (header.kind === "truth") on.truth(header.index, await createImageBitmap(new Blob([body])));
  else if (header.encoding === "raw") {
    const pixels = new Uint8ClampedArray(body);
    on.picture({ ...header, image: new ImageData(pixels, header.width, header.height) });
  } else {
    const image = await createImageBitmap(new Blob([body], { type: "image/jpeg" }));
    on.picture({ ...header, image });
  }
}
