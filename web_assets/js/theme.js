/** The page's theme, for what is drawn on a canvas or by another page. */

const scheme = matchMedia("(prefers-color-scheme: dark)");

/** @returns {Api.Theme} */
export function themeNow() {
  const { theme = scheme.matches ? "dark" : "light" } = document.documentElement.dataset;
  return /** @type {Api.Theme} */ (theme);
}

/** Calls `fn` when the theme was switched here or in the system. Returns a function that ends that. */
export function onTheme(/** @type {() => unknown} */ fn) {
  const watcher = new MutationObserver(fn);
  watcher.observe(document.documentElement, { attributeFilter: ["data-theme"] });
  scheme.addEventListener("change", fn);
  return () => {
    watcher.disconnect();
    scheme.removeEventListener("change", fn);
  };
}
