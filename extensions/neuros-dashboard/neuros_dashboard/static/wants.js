// What this page shows of packets, so that nodes sample that and nothing else.

export const WORLD = "#world"; // in place of a port: the simulated world of a node, if it has one

// "node.port" -> {node, port, all, image; of a world: frames, contacts;
// claims: by panel, {spikes: true} or {array: path}}
const wanted = new Map();
let page = null;
let timer = null;

export function begin(name, sources, nodes) {
  page = name;
  for (const source of sources) {
    const before = wanted.get(source.name);
    wanted.set(source.name, {
      node: source.node, port: source.port,
      all: before ? before.all : false,
      image: before ? before.image : false,
      claims: before ? before.claims : new Map(),
    });
  }
  for (const {name: node} of nodes) {
    const name = `${node}.${WORLD}`;
    wanted.set(name, wanted.get(name) ?? {node, port: WORLD, claims: new Map()});
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
    const {claims, ...rest} = entry;
    const isAsked = entry.all || entry.image || claims.size;
    if (!isAsked && entry.port !== WORLD) continue;
    const arrays = [...claims.values()].map((claim) => claim.array).filter(Boolean);
    const spikes = [...claims.values()].some((claim) => claim.spikes);
    asked[entry.node] ??= {};
    asked[entry.node][entry.port] = {...rest, arrays, spikes};
  }
  if (page !== null) {
    fetch("want", {method: "POST", body: JSON.stringify({page, wanted: asked})}).catch(() => {});
  }
}
