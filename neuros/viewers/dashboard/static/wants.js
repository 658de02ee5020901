// What this page shows of packets, so that nodes sample that and nothing else.

const wanted = new Map(); // "node.port" -> {node, port, fields: Set, all, image}
let page = null;
let timer = null;

export function begin(name, sources) {
  page = name;
  for (const source of sources) {
    const before = wanted.get(source.name);
    wanted.set(source.name, {
      node: source.node, port: source.port,
      fields: before ? before.fields : new Set(), all: before ? before.all : false,
      image: before ? before.image : false,
    });
  }
  tell();
}

export function want(source, change) {
  const entry = wanted.get(source);
  if (!entry) return;
  change(entry);
  clearTimeout(timer);
  timer = setTimeout(tell, 20);
}

// Of one source at a time, all fields are listed: that of the connection that was clicked.
export function wantAllOf(source) {
  for (const [name, entry] of wanted) entry.all = name === source;
  tell();
}

function tell() {
  const asked = {};
  for (const entry of wanted.values()) {
    if (!entry.fields.size && !entry.all && !entry.image) continue;
    asked[entry.node] ??= {};
    asked[entry.node][entry.port] = {
      fields: [...entry.fields], all: entry.all, image: entry.image,
    };
  }
  if (page !== null) {
    fetch("want", {method: "POST", body: JSON.stringify({page, wanted: asked})}).catch(() => {});
  }
}
