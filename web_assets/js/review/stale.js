export async function resolveStale() { return false; }
