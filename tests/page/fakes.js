// What the page's logic expects of a browser and of `app`, as far as it needs it without a display.

import { createState } from "../../web_assets/js/frame_state.js";

/** Resolves after everything that is ready has run. */
export const settled = () => new Promise((resolve) => setImmediate(resolve));

/** A promise with the functions that end it. */
export function held() {
  const made = {};
  made.promise = new Promise((resolve, reject) => Object.assign(made, { resolve, reject }));
  return made;
}

/** An empty `localStorage`, which the modules take from the global scope. */
export function freshStorage(kept = {}) {
  const values = new Map(Object.entries(kept));
  globalThis.localStorage = {
    getItem: (name) => values.get(name) ?? null,
    setItem: (name, value) => values.set(name, value),
  };
  return values;
}

/** An `app` whose requests are answered by `get`, `post` and `change`; what it says is in `told`. */
export function fakeApp({ state = {}, ...api } = {}) {
  const told = [];
  const effort = { actions: 0, action: (n = 1) => (effort.actions += n) };
  return {
    told,
    effort,
    api,
    state: createState({
      operator: "Ada",
      frame: null,
      jobs: [],
      project: null,
      route: { project: "room" },
      ...state,
    }),
    path: (...parts) => parts.join("/"),
    toast: (message) => told.push(message instanceof Error ? message.message : message),
    frames: { take: () => true },
  };
}

/** A state of a frame with labels, as the server sends it. */
export function frameState(revision, labels = [], id = 1, project = "room") {
  return {
    frame: { id, revision, recording: 1, attributes: {} },
    image: { url: `/${project}/${id}`, width: 640, height: 480 },
    labels,
    objects: [],
    image_boxes: null,
  };
}
