// Makes dist/, a folder that any static host can serve: rnd-view's page with an engine of its own, and onnxruntime.

import { build } from "esbuild";
import { cp, mkdir, readdir, rm, stat } from "node:fs/promises";
import { dirname, join } from "node:path";
import { fileURLToPath } from "node:url";

const here = dirname(fileURLToPath(import.meta.url));
const dist = join(here, "dist"), page = join(here, "../rnd_viewer/view/page");
const ort = join(here, "node_modules/onnxruntime-web/dist");
const ORT_FILES = ["ort.wasm.min.mjs", "ort-wasm-simd-threaded.mjs", "ort-wasm-simd-threaded.wasm"];
const EXAMPLE = ["avatar.onnx", "walk.npz", "sky.exr"];

await rm(dist, { recursive: true, force: true });
await mkdir(join(dist, "ort"), { recursive: true });
await cp(page, dist, { recursive: true });
await cp(join(here, "src/engine.js"), join(dist, "engine.js"));
for (const name of ORT_FILES) await cp(join(ort, name), join(dist, "ort", name));
await mkdir(join(dist, "example"));
for (const name of EXAMPLE) await cp(join(here, "../../assets", name), join(dist, "example", name));
await build({
  entryPoints: [join(here, "src/worker.js")],
  outfile: join(dist, "worker.js"),
  bundle: true,
  minify: true,
  format: "esm",
  target: "es2022",
  external: ["./ort/*"],  // left beside the page: it looks for its .wasm there
  loader: { ".vert": "text", ".frag": "text" },
});

let total = 0;
for (const entry of await readdir(dist, { recursive: true, withFileTypes: true })) {
  if (entry.isFile()) total += (await stat(join(entry.parentPath ?? entry.path, entry.name))).size;
}
console.log(`${dist}: ${(total / 1e6).toFixed(1)} MB`);
