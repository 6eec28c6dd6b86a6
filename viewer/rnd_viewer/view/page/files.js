// Files that a visitor brings: a drop zone while there is no avatar, the whole page afterwards.

const $ = (id) => document.getElementById(id);
const NONE = { avatar: "no avatar (.onnx) yet", motion: "no motion (.npz): it stands at rest", light: "no light (.hdr, .exr): the avatar's own" };

/** Send files to `load(files, idle)`, where `idle` is fulfilled as soon as no clip is being made; `busy` is whether one is. */
export function bindFiles(load, idle, busy, say) {
  $("files").hidden = $("zone").hidden = false;
  $("zone").addEventListener("pointerdown", (event) => event.stopPropagation());  // the camera stays
  const take = async (files) => {
    const list = [...files];  // the browser clears its list when this function awaits
    if (!list.length) return say("expected files, got something else", { wrong: true });
    if (busy()) await idle();
    say(`reading ${list.map((file) => file.name).join(", ")} …`);
    await load(list, idle);  // another clip may begin while it reads
  };
  for (const part of ["choose", "choose-first"]) $(part).addEventListener("change", () => {
    take($(part).files);
    $(part).value = "";  // so that a changed file of the same name can be chosen again
  });
  document.addEventListener("dragover", (event) => { event.preventDefault(); document.body.classList.add("over"); });
  document.addEventListener("dragleave", () => document.body.classList.remove("over"));
  document.addEventListener("drop", (event) => {
    event.preventDefault();
    document.body.classList.remove("over");
    take(event.dataTransfer.files);
  });
}

/** What is held before there is an avatar: names by kind, each may be missing. */
export function showHeld(held) {
  list($("held"), Object.entries(NONE).map(([kind, none]) => [held[kind] ? `✓ ${held[kind]}` : none, !held[kind]]));
}

/** The files, each with the reason, that the page's address names and that do not come. */
export function showMissing(reasons) {
  $("absent").hidden = false;
  list($("absent").querySelector("ul"), reasons.map((reason) => [reason, false]));
}

function list(element, entries) {
  element.replaceChildren(...entries.map(([text, faint]) => {
    const entry = document.createElement("li");
    entry.textContent = text;
    entry.classList.toggle("faint", faint);
    return entry;
  }));
}
