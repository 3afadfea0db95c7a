# Doxygen's filter for headers: awk -f header.awk FILE. Makes documentation of plain comments: // before a declaration,
# and // behind a member.

# What Doxygen would take for a command, a tag or a link.
function plain(text)
{
    gsub(/[\\@<>#&]/, "\\\\&", text)
    return text
}

# Prints the comment that has been collected. A comment on a part of a file is none of Doxygen's.
function endComment(isDocumentation,    i, verbatim, text)
{
    for (i = 1; i <= count; ++i) {
        text = comment[i]
        if (!isDocumentation) {
            print indent "//" text
            continue
        }
        if ((text ~ /^   +[^ ]/) != verbatim) { # code and tables stay as they stand
            verbatim = !verbatim
            print indent (verbatim ? "/// @code{.txt}" : "/// @endcode")
        }
        print indent "///" (verbatim ? text : plain(text))
    }
    if (verbatim)
        print indent "/// @endcode"
    count = 0
}

FNR == 1 && /^\/\// {
    print "/// @file"
    ofFile = 1
    if (match($0, /^\/\/ [A-Z][A-Za-z]*: /)) # the name of the class that the file is about
        subject = substr($0, 4, RLENGTH - 5)
}

# The class that the file is about has the file's comment, if it has no other.
ofFile && /^\/\// {
    ofSubject[++subjectCount] = substr($0, 3)
}

subject != "" && count == 0 && $0 ~ "^(class|struct) " subject "[ {;]" {
    sub(/^ [A-Z][A-Za-z]*: /, "", ofSubject[1])
    ofSubject[1] = " " toupper(substr(ofSubject[1], 1, 1)) substr(ofSubject[1], 2)
    for (count = 1; count <= subjectCount; ++count)
        comment[count] = ofSubject[count]
    count = subjectCount
}

# What Doxygen would link to, although it does not document it: private classes and friends
/^ *friend (class|struct) / {
    endComment(0)
    print ""
    next
}

/^ *private:$/ {
    endComment(0)
    private = $0
    sub(/private:$/, "", private)
    hidden = 1
}

hidden {
    if ($0 != private "};" && $0 !~ "^" private "(public|protected):$") {
        print ""
        next
    }
    hidden = 0
}

/^ *\/\// {
    column = index($0, "//")
    if (behind == column) { # the comment behind a member goes on
        print substr($0, 1, column - 1) "///<" plain(substr($0, column + 2))
        next
    }
    indent = substr($0, 1, column - 1)
    comment[++count] = substr($0, column + 2)
    next
}

{
    endComment(ofFile || $0 !~ /^(namespace .*)?$/)
    ofFile = 0
    behind = 0
    column = index($0, "//")
    code = substr($0, 1, column - 1)
    quotes = gsub(/"/, "\"", code)
    if (column && quotes % 2 == 0 && code ~ /([;,]|^ +[A-Z][A-Za-z0-9]*) *$/) { # the last of an enum has no comma
        behind = column
        print code "///<" plain(substr($0, column + 2))
        next
    }
    print
}
