/** Loads small pictures one after the other, while no frame is being opened: the server has to read one, then. */

/** So long after a frame was opened. */
const CALM_MS = 1500;

export function createLoader(/** @type {() => void} */ onLoaded) {
  /** Whether there is a picture. @type {Map<string, boolean>} */
  const known = new Map();
  /** @type {string[]} */
  let wanted = [];
  let isLoading = false;
  let restUntil = 0;

  async function load() {
    if (isLoading) return;
    isLoading = true;
    for (;;) {
      const url = wanted.find((each) => !known.has(each));
      const wait = restUntil - performance.now();
      if (url === undefined) break;
      if (wait > 0) {
        await new Promise((resolve) => setTimeout(resolve, wait));
        continue;
      }
      const begun = performance.now();
      const image = new Image();
      image.fetchPriority = "low";
      image.src = url;
      // of a frame that cannot be read, there is none; opening the frame says why
      const isThere = await image.decode().then(
        () => true,
        () => false,
      );
      known.set(url, isThere);
      // half of the server's time at most
      restUntil = Math.max(restUntil, 2 * performance.now() - begun);
      if (isThere) onLoaded();
    }
    isLoading = false;
  }

  return {
    has: (/** @type {string} */ url) => known.get(url) === true,
    want(/** @type {string[]} */ urls) {
      wanted = urls;
      void load();
    },
    rest() {
      restUntil = performance.now() + CALM_MS;
    },
  };
}
