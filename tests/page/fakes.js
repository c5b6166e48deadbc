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
  const values = createState({
    operator: "Ada",
    frame: null,
    jobs: [],
    project: null,
    route: { project: "room" },
    ...state,
  });
  return {
    told,
    effort,
    api,
    state: values,
    path: (...parts) => parts.join("/"),
    toast: (message) => told.push(message instanceof Error ? message.message : message),
    frames: { take: () => true, of: async () => values.frame, giveUp() {} },
  };
}

/** A state of a frame with labels, as the server sends it. */
export function frameState(revision, labels = [], id = 1, project = "room") {
  return {
    frame: { id, revision, recording: 1, cameras: { 1: id }, T_camera_cloud: null, attributes: {} },
    image: { url: `/${project}/${id}`, width: 640, height: 480 },
    labels,
    objects: [],
    image_boxes: null,
  };
}

/** An element without a display: it keeps attributes, children and listeners. */
class FakeElement extends EventTarget {
  constructor(tagName) {
    super();
    Object.assign(this, {
      tagName,
      attributes: {},
      children: [],
      style: {},
      dataset: {},
      clientLeft: 0,
      clientTop: 0,
    });
    this.classList = { add() {}, remove() {}, toggle() {} };
  }
  setAttribute(name, value) {
    this.attributes[name] = value;
  }
  removeAttribute(name) {
    delete this.attributes[name];
  }
  append(...children) {
    this.children.push(...children);
  }
  replaceChildren(...children) {
    this.children = children;
  }
  getBoundingClientRect = () => ({ left: 0, top: 0, width: 700, height: 500 });
  closest = () => null;
  matches = () => true;
  contains = (other) => other === this;
  focus() {}
  remove() {}
  setPointerCapture() {}
}

/** The browser's globals that the 2D editor takes: elements of 700 x 500 px, and pictures that are decoded at once. */
export function fakeBrowser() {
  const make = (tagName) => new FakeElement(tagName);
  Object.assign(globalThis, {
    Element: FakeElement,
    HTMLElement: FakeElement,
    document: { createElement: make, createElementNS: (_, tagName) => make(tagName), activeElement: null },
    window: new EventTarget(),
    devicePixelRatio: 1,
    requestAnimationFrame: () => 0,
    cancelAnimationFrame() {},
    ResizeObserver: class {
      observe() {}
      disconnect() {}
    },
    Image: class {
      naturalWidth = 1;
      decode = async () => {};
    },
  });
  return make;
}

/** A box 3 m before the camera, and a longer one. */
export const BOX = {
  center: [0, 0, 3],
  size: [1, 1, 1],
  rotation: [
    [1, 0, 0],
    [0, 1, 0],
    [0, 0, 1],
  ],
};
export const LONGER = { ...BOX, size: [2, 1, 1] };
