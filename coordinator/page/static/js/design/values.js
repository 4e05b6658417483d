// Values as people write them in a form.

/** A value as a person writes it: $name is a variable, everything else JSON or plain text. */
export function readValue(text) {
  const trimmed = text.trim();
  if (trimmed.startsWith("$")) return { var: trimmed.slice(1) };
  try {
    return JSON.parse(trimmed);
  } catch {
    return trimmed;
  }
}

export const writeValue = (value) => (value && typeof value === "object" && typeof value.var === "string" ? `$${value.var}` : typeof value === "string" && !/^$|^[-\d$"[{]|^(true|false|null)$/.test(value) ? value : JSON.stringify(value));
