! dfb from Fortran: the functions of dfb.h, over ISO_C_BINDING. What they do, which of them are collective, what they wait
! for and what they return is said there. Compile this file with your own; a .mod file belongs to one compiler.
!
! A framebuffer is a type(c_ptr). Functions return DFB_OK or another status; dfb_last_error() has the text. A pixel's
! channels are the first index of an array of colours, x is the second, y the third; y counts from the top.
module dfb
  use, intrinsic :: iso_c_binding
  implicit none
  private

  ! dfb_status
  integer(c_int), parameter, public :: DFB_OK = 0, DFB_INVALID_ARGUMENT = 1, DFB_FRAME_FAILED = 2, &
    DFB_TRANSPORT_FAILED = 3, DFB_OUT_OF_MEMORY = 4, DFB_FAILED = 5
  ! dfb_blend
  integer(c_int), parameter, public :: DFB_NEAREST = 0, DFB_BY_DEPTH = 1, DFB_IN_ORDER = 2
  ! dfb_format
  integer(c_int), parameter, public :: DFB_RGBA8 = 0, DFB_SRGBA8 = 1, DFB_RGBA32F = 2

  type, bind(c), public :: dfb_config
    integer(c_size_t) :: struct_size
    integer(c_int) :: width, height, blend, format, depth, display_rank, threads
    real(c_float) :: background(4)
    integer(c_int) :: timeout_ms
  end type

  ! The pointers by c_loc() of arrays of integer(c_int8_t) or real(c_float).
  type, bind(c), public :: dfb_input
    integer(c_size_t) :: struct_size
    type(c_ptr) :: rgba8, rgba32f, depth
    integer(c_ptrdiff_t) :: row_pixels
    integer(c_int) :: bottom_up, is_bgra, has_straight_alpha
    real(c_float) :: far_depth
    integer(c_int) :: region(4), valid(4)
  end type

  type, bind(c), public :: dfb_brick
    integer(c_int32_t) :: id
    real(c_float) :: lower(3), upper(3)
  end type

  type, bind(c), public :: dfb_tile
    integer(c_int) :: x0, y0, x1, y1, width, height
    integer(c_ptrdiff_t) :: row_pixels
    type(c_ptr) :: rgba, depth
  end type

  type, bind(c), public :: dfb_report
    integer(c_int64_t) :: frame
    real(c_double) :: total_ms, render_ms, compositing_overhead_ms, render_ms_max
    integer(c_int64_t) :: bytes_sent, messages_sent, tiles_total, tiles_touched, non_finite_pixels, &
      alpha_outside_pixels, order_undefined_pixels, peak_memory_bytes
    integer(c_int) :: threads
  end type

  abstract interface
    ! A renderer of bricks: a procedure of a module or a file, with bind(c). Returns 0, or another number if it failed.
    function dfb_render_brick(brick, tile, user) bind(c) result(code)
      import :: dfb_brick, dfb_tile, c_ptr, c_int
      type(dfb_brick), intent(in) :: brick
      type(dfb_tile), intent(in) :: tile
      type(c_ptr), value :: user
      integer(c_int) :: code
    end function
  end interface
  public :: dfb_render_brick

  interface
    ! `communicator`: that of `use mpi`, or the mpi_val of one of `use mpi_f08`.
    function dfb_create(communicator, config, framebuffer) bind(c, name='dfb_create_fortran') result(status)
      import :: dfb_config, c_ptr, c_int
      integer(c_int), value :: communicator
      type(dfb_config), intent(in) :: config
      type(c_ptr), intent(out) :: framebuffer
      integer(c_int) :: status
    end function
    subroutine dfb_destroy(framebuffer) bind(c, name='dfb_destroy')
      import :: c_ptr
      type(c_ptr), value :: framebuffer
    end subroutine
    function dfb_resize(framebuffer, width, height) bind(c, name='dfb_resize') result(status)
      import :: c_ptr, c_int
      type(c_ptr), value :: framebuffer
      integer(c_int), value :: width, height
      integer(c_int) :: status
    end function
    function dfb_composite(framebuffer, input, place) bind(c, name='dfb_composite') result(status)
      import :: dfb_input, c_ptr, c_int
      type(c_ptr), value :: framebuffer
      type(dfb_input), intent(in), optional :: input ! without one: this rank could not make its image
      integer(c_int), value :: place
      integer(c_int) :: status
    end function
    function dfb_image_on_all_ranks(framebuffer) bind(c, name='dfb_image_on_all_ranks') result(status)
      import :: c_ptr, c_int
      type(c_ptr), value :: framebuffer
      integer(c_int) :: status
    end function
    function dfb_rank(framebuffer) bind(c, name='dfb_rank') result(rank)
      import :: c_ptr, c_int
      type(c_ptr), value :: framebuffer
      integer(c_int) :: rank
    end function
    function dfb_size(framebuffer) bind(c, name='dfb_size') result(ranks)
      import :: c_ptr, c_int
      type(c_ptr), value :: framebuffer
      integer(c_int) :: ranks
    end function
    function dfb_width(framebuffer) bind(c, name='dfb_width') result(width)
      import :: c_ptr, c_int
      type(c_ptr), value :: framebuffer
      integer(c_int) :: width
    end function
    function dfb_height(framebuffer) bind(c, name='dfb_height') result(height)
      import :: c_ptr, c_int
      type(c_ptr), value :: framebuffer
      integer(c_int) :: height
    end function
  end interface
  public :: dfb_create, dfb_destroy, dfb_resize, dfb_composite, dfb_image_on_all_ranks, dfb_rank, dfb_size, dfb_width, &
    dfb_height
  public :: dfb_config_init, dfb_input_init, dfb_is_display_rank, dfb_render, dfb_tile_pixels, dfb_image_rgba8, &
    dfb_image_rgba32f, dfb_image_depth, dfb_get_report, dfb_last_error, dfb_version

  ! The C functions that the procedures below call.
  interface
    subroutine c_config_init(config, struct_size, width, height) bind(c, name='dfb_config_init_sized')
      import :: dfb_config, c_size_t, c_int
      type(dfb_config), intent(out) :: config
      integer(c_size_t), value :: struct_size
      integer(c_int), value :: width, height
    end subroutine
    subroutine c_input_init(input, struct_size) bind(c, name='dfb_input_init_sized')
      import :: dfb_input, c_size_t
      type(dfb_input), intent(out) :: input
      integer(c_size_t), value :: struct_size
    end subroutine
    function c_is_display_rank(framebuffer) bind(c, name='dfb_is_display_rank') result(is_it)
      import :: c_ptr, c_int
      type(c_ptr), value :: framebuffer
      integer(c_int) :: is_it
    end function
    function c_render(framebuffer, bricks, count, view, projection, render_brick, user) bind(c, name='dfb_render') &
        result(status)
      import :: dfb_brick, c_ptr, c_funptr, c_double, c_int
      type(c_ptr), value :: framebuffer
      type(dfb_brick), intent(in) :: bricks(*)
      integer(c_int), value :: count
      real(c_double), intent(in) :: view(16), projection(16)
      type(c_funptr), value :: render_brick
      type(c_ptr), value :: user
      integer(c_int) :: status
    end function
    function c_image_rgba8(framebuffer) bind(c, name='dfb_image_rgba8') result(pixels)
      import :: c_ptr
      type(c_ptr), value :: framebuffer
      type(c_ptr) :: pixels
    end function
    function c_image_rgba32f(framebuffer) bind(c, name='dfb_image_rgba32f') result(pixels)
      import :: c_ptr
      type(c_ptr), value :: framebuffer
      type(c_ptr) :: pixels
    end function
    function c_image_depth(framebuffer) bind(c, name='dfb_image_depth') result(depths)
      import :: c_ptr
      type(c_ptr), value :: framebuffer
      type(c_ptr) :: depths
    end function
    function c_get_report(framebuffer, report, struct_size) bind(c, name='dfb_get_report_sized') result(status)
      import :: dfb_report, c_ptr, c_size_t, c_int
      type(c_ptr), value :: framebuffer
      type(dfb_report), intent(inout) :: report
      integer(c_size_t), value :: struct_size
      integer(c_int) :: status
    end function
    function c_last_error() bind(c, name='dfb_last_error') result(text)
      import :: c_ptr
      type(c_ptr) :: text
    end function
    function c_version() bind(c, name='dfb_version') result(text)
      import :: c_ptr
      type(c_ptr) :: text
    end function
    function c_strlen(text) bind(c, name='strlen') result(length)
      import :: c_ptr, c_size_t
      type(c_ptr), value :: text
      integer(c_size_t) :: length
    end function
  end interface

contains

  subroutine dfb_config_init(config, width, height)
    type(dfb_config), intent(out) :: config
    integer, intent(in) :: width, height
    call c_config_init(config, c_sizeof(config), int(width, c_int), int(height, c_int))
  end subroutine

  subroutine dfb_input_init(input)
    type(dfb_input), intent(out) :: input
    call c_input_init(input, c_sizeof(input))
  end subroutine

  logical function dfb_is_display_rank(framebuffer)
    type(c_ptr), intent(in) :: framebuffer
    dfb_is_display_rank = c_is_display_rank(framebuffer) /= 0
  end function

  ! `user` is handed to the renderer; c_null_ptr by default.
  function dfb_render(framebuffer, bricks, view, projection, render_brick, user) result(status)
    type(c_ptr), intent(in) :: framebuffer
    type(dfb_brick), intent(in) :: bricks(:)
    real(c_double), intent(in) :: view(4, 4), projection(4, 4)
    procedure(dfb_render_brick) :: render_brick
    type(c_ptr), intent(in), optional :: user
    integer(c_int) :: status
    type(c_ptr) :: handed
    handed = c_null_ptr
    if (present(user)) handed = user
    status = c_render(framebuffer, bricks, size(bricks, kind=c_int), view, projection, c_funloc(render_brick), handed)
  end function

  ! The pixels of a tile: rgba(1:4, x, y) and depth(x, y), where x and y are their places in the picture.
  subroutine dfb_tile_pixels(tile, rgba, depth)
    type(dfb_tile), intent(in) :: tile
    real(c_float), pointer, intent(out) :: rgba(:, :, :), depth(:, :)
    real(c_float), pointer :: colors(:, :, :), depths(:, :)
    integer :: columns, rows
    columns = int(tile%row_pixels)
    rows = tile%y1 - tile%y0
    call c_f_pointer(tile%rgba, colors, [4, columns, rows])
    call c_f_pointer(tile%depth, depths, [columns, rows])
    rgba(1:, tile%x0:, tile%y0:) => colors
    depth(tile%x0:, tile%y0:) => depths
  end subroutine

  ! The last picture: pixels(1:4, 1:width, 1:height); null if there is none. The bits of a byte are those of C's uint8_t.
  subroutine dfb_image_rgba8(framebuffer, pixels)
    type(c_ptr), intent(in) :: framebuffer
    integer(c_int8_t), pointer, intent(out) :: pixels(:, :, :)
    type(c_ptr) :: first
    nullify (pixels)
    first = c_image_rgba8(framebuffer)
    if (c_associated(first)) call c_f_pointer(first, pixels, [4_c_int, dfb_width(framebuffer), dfb_height(framebuffer)])
  end subroutine

  subroutine dfb_image_rgba32f(framebuffer, pixels)
    type(c_ptr), intent(in) :: framebuffer
    real(c_float), pointer, intent(out) :: pixels(:, :, :)
    type(c_ptr) :: first
    nullify (pixels)
    first = c_image_rgba32f(framebuffer)
    if (c_associated(first)) call c_f_pointer(first, pixels, [4_c_int, dfb_width(framebuffer), dfb_height(framebuffer)])
  end subroutine

  ! The last picture's depths(1:width, 1:height); null if there are none.
  subroutine dfb_image_depth(framebuffer, depths)
    type(c_ptr), intent(in) :: framebuffer
    real(c_float), pointer, intent(out) :: depths(:, :)
    type(c_ptr) :: first
    nullify (depths)
    first = c_image_depth(framebuffer)
    if (c_associated(first)) call c_f_pointer(first, depths, [dfb_width(framebuffer), dfb_height(framebuffer)])
  end subroutine

  function dfb_get_report(framebuffer, report) result(status)
    type(c_ptr), intent(in) :: framebuffer
    type(dfb_report), intent(inout) :: report
    integer(c_int) :: status
    status = c_get_report(framebuffer, report, c_sizeof(report))
  end function

  function dfb_last_error() result(text)
    character(len=:), allocatable :: text
    text = text_of(c_last_error())
  end function

  function dfb_version() result(text)
    character(len=:), allocatable :: text
    text = text_of(c_version())
  end function

  function text_of(pointer) result(text)
    type(c_ptr), intent(in) :: pointer
    character(len=:), allocatable :: text
    character(kind=c_char), pointer :: letters(:)
    integer :: i
    call c_f_pointer(pointer, letters, [c_strlen(pointer)])
    allocate (character(len=size(letters)) :: text)
    do i = 1, size(letters)
      text(i:i) = letters(i)
    end do
  end function
end module
