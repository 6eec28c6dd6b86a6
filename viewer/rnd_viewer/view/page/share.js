// The state in the page's address.

const KEPT = ["azimuth", "elevation", "distance", "target", "fov", "time", "light", "yaw", "exposure", "shade", "output", "background", "tone", "ground", "gaussians"];

/** The page's address with `state` in it, without the token of rnd-view; the size is the window's. */
export function addressWith(state) {
  const address = new URL(location.href);
  const words = address.search.slice(1).split("&");  // as they are: a list's commas are not to be encoded
  address.search = words.filter((word) => !word.startsWith("token=")).join("&");
  const kept = KEPT.filter((name) => state[name] !== null).map((name) => [name, [state[name]].flat().map(short).join()]);
  address.hash = new URLSearchParams(kept);
  return address.href;
}

const short = (value) => (typeof value === "number" ? Number(value.toPrecision(6)) : value);

/** What of `state` the page's address holds; what is damaged is left out. */
export function stateOfAddress(state) {
  const read = (name, text) => {
    const like = name === "gaussians" ? 0 : state[name], numbers = text.split(",").map(Number);
    if (typeof like === "boolean") return { true: true, false: false }[text];
    if (typeof like === "string") return text;
    if (numbers.length !== [like].flat().length || !numbers.every(Number.isFinite)) return undefined;
    return Array.isArray(like) ? numbers : numbers[0];
  };
  const given = [...new URLSearchParams(location.hash.slice(1))].filter(([name]) => KEPT.includes(name));
  return Object.fromEntries(given.map(([name, text]) => [name, read(name, text)]).filter(([, value]) => value !== undefined));
}
