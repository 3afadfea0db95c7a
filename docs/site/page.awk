# Doxygen's filter for pages: awk -v root=DIR -f page.awk FILE. Names pages and headings, and makes references of links,
# so that Doxygen finds those that lead nowhere. DIR is the folder that links are looked up in.

# "docs/../examples/x.cpp" to "examples/x.cpp"
function normal(path,    parts, count, i, kept, text)
{
    count = split(path, parts, "/")
    kept = 0
    for (i = 1; i <= count; ++i) {
        if (parts[i] == "..")
            --kept
        else if (parts[i] != ".")
            parts[++kept] = parts[i]
    }
    text = parts[1]
    for (i = 2; i <= kept; ++i)
        text = text "/" parts[i]
    return text
}

function pageName(path)
{
    gsub(/[^A-Za-z0-9]/, "_", path)
    return "page_" path
}

# The anchors that GitHub gives to headings
function anchor(heading)
{
    heading = tolower(heading)
    gsub(/[^a-z0-9 _-]/, "", heading)
    gsub(/ /, "-", heading)
    return heading
}

function reference(link,    hash, page)
{
    if (link ~ /^[a-z]+:/)
        return link
    hash = index(link, "#")
    page = hash == 1 ? self : normal(folder (hash ? substr(link, 1, hash - 1) : link))
    if (page !~ /\.md$/) {
        sub(/^.*\//, "", page)
        return page ~ /\.(cpp|c|f90)$/ ? "@ref " page : page
    }
    return "@ref " pageName(page) (hash ? "_" substr(link, hash + 1) : "")
}

function withReferences(line,    out, at, end, text)
{
    while (match(line, /\[`[^`]*`\]\(/)) { # Doxygen shows the marks of code within a link
        text = substr(line, RSTART, RLENGTH)
        gsub(/`/, "", text)
        line = substr(line, 1, RSTART - 1) text substr(line, RSTART + RLENGTH)
    }
    out = ""
    while (at = index(line, "](")) {
        end = index(substr(line, at), ")")
        if (!end)
            break
        out = out substr(line, 1, at + 1) reference(substr(line, at + 2, end - 3)) ")"
        line = substr(line, at + end)
    }
    return out line
}

FNR == 1 {
    self = substr(FILENAME, length(root) + 2)
    folder = self
    sub(/[^\/]*$/, "", folder)
}

/^ *```/ {
    code = !code
}

# Indented lines behind an empty one are code, too; in a list, those behind a line of text are not.
{
    isCode = code || (/^    / && (isCode || isBehindEmpty))
    isBehindEmpty = /^$/
}

isCode {
    print
    next
}

/^#+ / {
    gsub(/\]\([^)]*\)/, "") # a heading with a link loses it
    gsub(/\[/, "")
    heading = $0
    sub(/^#+ /, "", heading)
    print $0 " {#" pageName(self) (/^# / ? "" : "_" anchor(heading)) "}"
    next
}

{
    print withReferences($0)
}
