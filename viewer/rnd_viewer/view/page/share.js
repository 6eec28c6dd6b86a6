// The state in the page's address.

const KEPT = ["azimuth", "elevation", "distance", "target", "fov", "time", "light", "yaw", "exposure", "shade", "output", "background", "tone", "ground", "gaussians"];

/** The page's address with `state` in it, without the token of rnd-view; the size is the window's. */
export function addressWith(state) {
  const address = new URL(location.href);
  const words = address.search.slice(1).split("&");  // as they are: a list's commas are not to be encoded
  address.search = words.filter((word) => !word.startsWith("token=")).join("&");
  address.hash = encodeURIComponent(JSON.stringify(Object.fromEntries(KEPT.map((name) => [name, state[name]]))));
  return address.href;
}

/** What of `state` the page's address holds; nothing where it is damaged. */
export function stateOfAddress(state) {
  let given = null;
  try { given = JSON.parse(decodeURIComponent(location.hash.slice(1))); } catch { /* not ours */ }
  if (given === null || typeof given !== "object") return {};
  const fits = (value, like) => (Array.isArray(like) ? Array.isArray(value) && value.length === like.length && value.every(Number.isFinite)
    : typeof value === typeof like);
  return Object.fromEntries(KEPT.map((name) => [name, given[name]]).filter(([name, value]) =>
    fits(value, state[name]) || (name === "gaussians" && Number.isInteger(value))));
}
