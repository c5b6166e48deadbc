/**
 * Objects whose image box was moved. Their boxes on views are transferred to the new views (carry.js) before the
 * object is saved: otherwise the server would take pixels of the old views for pixels of the new ones.
 */

/**
 * An object that was moved. `views` is the latest loading; null if the views must be loaded again.
 *
 * @typedef {{ draft: Draft, views: Promise<boolean> | null, isWaiting: boolean }} Move
 */

/** @param {StepLoader} loader */
export function createMoves(loader) {
  /**
   * Kept afterwards, because the drafts contain, as guesses, the boxes that could not be transferred.
   *
   * @type {WeakMap<Item, Move>}
   */
  const moves = new WeakMap();

  /**
   * Loads a draft's views with the loader.
   *
   * @param {Draft} draft
   * @param {boolean} suggest
   */
  function load(draft, suggest) {
    const views = loader.load(draft, suggest);
    const move = moves.get(draft.item);
    if (move) move.views = views;
    return views;
  }

  return {
    load,
    /**
     * True if an object's boxes have not been transferred to its new views yet.
     *
     * @param {Item} item
     */
    isWaiting: (item) => Boolean(moves.get(item)?.isWaiting),
    /**
     * The draft of an object that was moved.
     *
     * @param {Item} item
     */
    draftOf: (item) => moves.get(item)?.draft ?? null,
    /**
     * From now on, saving a draft's object waits for its views.
     *
     * @param {Draft} draft
     */
    start: (draft) => moves.set(draft.item, { draft, views: null, isWaiting: true }),

    /**
     * Forgets a move: the object was removed, or another version of it was taken.
     *
     * @param {Item} item
     */
    forget(item) {
      moves.delete(item);
      loader.stop(item);
    },

    /**
     * Stops loading the views of a draft that is no longer the current one, unless its object was moved.
     *
     * @param {Draft | null} draft
     */
    leave(draft) {
      if (draft && !moves.get(draft.item)?.isWaiting) loader.stop(draft.item);
    },

    /**
     * Resolves to true once an object's boxes are on its own views, to false if it is gone. Rejects if its views
     * cannot be loaded; another call tries again.
     *
     * @param {Item} item
     * @param {(draft: Draft) => void} ask loads the views with `load`.
     */
    async settle(item, ask) {
      for (let move = moves.get(item); move?.isWaiting && move === moves.get(item); ) {
        if (!move.views) ask(move.draft);
        const { views } = move;
        try {
          const isNewest = await views;
          if (move.views !== views) continue;
          move.isWaiting = !isNewest;
          if (isNewest) return true;
          move.views = null;
        } catch (error) {
          if (move.views !== views) continue;
          move.views = null;
          if (move === moves.get(item)) throw error;
        }
      }
      return false;
    },
  };
}
