/**
 * The state shared by the whole page. Read `state.name`, write `state.set({name: value})`, listen with
 * `state.on("name", fn)`.
 */

/**
 * @param {StateValues} initial
 * @returns {State}
 */
export function createState(initial) {
  /** @type {Map<string, Set<(value: never) => unknown>>} */
  const listeners = new Map();
  /** @type {State} */
  const state = {
    ...initial,

    // listeners are called even if a value is the same object as before
    set(changes) {
      Object.assign(state, changes);
      for (const [name, value] of Object.entries(changes)) {
        for (const fn of [...(listeners.get(name) ?? [])]) fn(/** @type {never} */ (value));
      }
    },

    on(name, fn) {
      const known = listeners.get(name) ?? new Set();
      listeners.set(name, known.add(fn));
      return () => known.delete(fn);
    },
  };
  return state;
}
