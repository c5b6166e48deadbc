/** Dark, light, or the system's choice; kept in this browser. */

const ORDER = ["system", "dark", "light"];

export function currentTheme() {
  const kept = localStorage.getItem("theme");
  return kept !== null && ORDER.includes(kept) ? kept : "system";
}

export function applyTheme(theme = currentTheme()) {
  if (theme === "system") delete document.documentElement.dataset.theme;
  else document.documentElement.dataset.theme = theme;
}

/** Switches to the next of the three; returns its name. */
export function switchTheme() {
  const next = ORDER[(ORDER.indexOf(currentTheme()) + 1) % ORDER.length];
  localStorage.setItem("theme", next);
  applyTheme(next);
  return next;
}
