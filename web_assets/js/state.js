/** What the whole page knows. Read `state.name`; write with `state.set({name: value})`; listen with `state.on("name", fn)`. */

export function createState(initial) {
  const listeners = new Map();
  const state = {
    ...initial,

    /** Sets values and tells their listeners, also when a value is the same object as before. */
    set(changes) {
      Object.assign(state, changes);
      for (const name of Object.keys(changes)) for (const fn of [...(listeners.get(name) ?? [])]) fn(state[name]);
    },

    /** Calls `fn(value)` after each set of `name`. Returns the function that ends this. */
    on(name, fn) {
      if (!listeners.has(name)) listeners.set(name, new Set());
      listeners.get(name).add(fn);
      return () => listeners.get(name).delete(fn);
    },
  };
  return state;
}
