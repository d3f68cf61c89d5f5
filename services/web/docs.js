// The OpenAPI document as a list: what there is, what it takes, what it means.
"use strict";
fetch("/v1/openapi.json").then((answer) => answer.json()).then((api) => {
  const add = (parent, name, text) => { const made = document.createElement(name); made.textContent = text; parent.append(made); return made; };
  const kind = (schema) => schema?.type || (schema?.anyOf || []).map((s) => s.type).filter((t) => t && t !== "null").join(" or ") || "object";
  for (const [path, methods] of Object.entries(api.paths)) {
    for (const [method, operation] of Object.entries(methods)) {
      const box = document.getElementById("paths");
      add(box, "h3", operation.summary);
      add(add(box, "p", ""), "code", `${method.toUpperCase()} ${path}`);
      for (const part of (operation.description || "").split(/\n\s*\n/).filter(Boolean)) {
        const text = add(box, "p", "");
        part.split("`").forEach((piece, i) => add(text, i % 2 ? "code" : "span", piece));
      }
      const list = add(box, "ul", "");
      for (const p of operation.parameters || []) add(list, "li", `${p.name} (${p.in}, ${kind(p.schema)}${p.required ? ", required" : ""})`);
      const body = operation.requestBody?.content || {};
      for (const [type, { schema }] of Object.entries(body)) {
        const found = schema.$ref ? api.components.schemas[schema.$ref.split("/").at(-1)] : schema;
        add(list, "li", `body, ${type}: ${Object.entries(found.properties || {}).map(([n, s]) => `${n} (${kind(s)})`).join(", ")}`);
      }
    }
  }
});
