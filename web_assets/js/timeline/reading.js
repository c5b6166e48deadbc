/** Keeps `state.timeline`, the frames and tracks of the open frame's recording, as the server has them. */

/** It is read again this long after a change, or after ten times as long as reading took. */
const CALM_MS = 300;
const REST = 10;

export function readTimeline(/** @type {App} */ app) {
  const { state, events } = app;
  /** @type {number | null} */
  let wanted = null;
  let readings = 0;
  let timer = 0;
  let tookMs = 0;

  async function read() {
    clearTimeout(timer);
    timer = 0;
    const [recording, project] = [wanted, state.route.project];
    if (recording === null || project === null) return;
    readings += 1;
    const own = readings;
    const begun = performance.now();
    try {
      const found = await app.api.get(app.path("recordings", recording, "tracks"));
      if (own !== readings) return;
      const pictures = app.path("frames");
      const picture = (/** @type {number} */ frame) => `${pictures}/${frame}/image.jpg?width=96&${found.pictures}`;
      state.set({ timeline: { ...found, picture, places: new Map(found.frames.map((id, place) => [id, place])) } });
    } catch (error) {
      if (own === readings) app.toast(error);
    } finally {
      tookMs = performance.now() - begun;
    }
  }

  function readSoon() {
    if (timer === 0) timer = setTimeout(read, Math.max(CALM_MS, REST * tookMs));
  }

  state.on("frame", (frame) => {
    if (frame === null || frame.frame.recording === wanted) return;
    wanted = frame.frame.recording;
    state.set({ span: null });
    void read();
  });
  state.on("project", (project) => {
    if (project !== null) return;
    wanted = null;
    readings += 1;
    clearTimeout(timer);
    timer = 0;
    state.set({ timeline: null, span: null });
  });
  events.on("frame", ({ frame }) => state.timeline?.places.has(frame) && readSoon());
  for (const type of /** @type {const} */ (["classes", "recordings", "renamed", "adjusted", "still", "reconnected"]))
    events.on(type, readSoon);
}

/** What a frame is called: its number in the open recording, as in the top bar; its key if it is of another one. */
export const frameName = (
  /** @type {State} */ { timeline },
  /** @type {number} */ frame,
  /** @type {string} */ key,
) => {
  const place = timeline?.places.get(frame);
  return place === undefined ? key : String(place + 1);
};

/** The place of the open frame, also of one that cannot be read; -1 if it is not known. */
export const placeNow = (/** @type {State} */ { timeline, frame, route }) =>
  timeline?.places.get(frame?.frame.id ?? route.frame ?? -1) ?? -1;
